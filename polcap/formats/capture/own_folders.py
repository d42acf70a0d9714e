"""Names of the folders that polcap makes among photographs."""

OUTPUT = "polcap"  # default folder of results
BATCH = "polcap-batch"  # folder of a batch's records, in ROOT or in --out; safe to delete
OURS = (OUTPUT, BATCH)  # these folders hold no photographs
