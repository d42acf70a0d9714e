#!/bin/sh
#SBATCH --job-name=$name
#SBATCH --array=1-$shards
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=$cores
#SBATCH --mem=${memory_mb}M
#SBATCH --output=$log
#SBATCH --requeue
$command
