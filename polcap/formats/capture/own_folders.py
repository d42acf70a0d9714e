"""Names of the folders that polcap makes among photographs."""

OUTPUT = "polcap"  # where results go by default
BATCH = "polcap-batch"  # where a batch keeps its records: in ROOT or in --out; safe to delete
OURS = (OUTPUT, BATCH)
