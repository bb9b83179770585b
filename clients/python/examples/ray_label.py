#!/usr/bin/env python3
"""Labels the pairs of a Parquet table on a Ray cluster.

    ray job submit -- python ray_label.py s3://lake/pairs.parquet s3://lake/flow/run-7

The table has the columns key, source and target. A run that was cut off goes on when it is started again.
"""

import sys

import ray

import fnsf.bulk

table, output = sys.argv[1:]
pairs = ray.data.read_parquet(table).repartition(200)
report = fnsf.bulk.ray_label(pairs, output, preset="default", num_cpus=2, concurrency=(1, 100))
# Else each use of the report would label the pairs again.
report = report.materialize()
report.write_parquet(f"{output}-report")
print(report.groupby("outcome").count().to_pandas())
