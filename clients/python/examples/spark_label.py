#!/usr/bin/env python3
"""Labels the pairs of a Parquet table on Spark.

    spark-submit --conf spark.task.cpus=2 spark_label.py s3a://lake/pairs.parquet s3a://lake/flow/run-7

The table has the columns key, source and target. A run that was cut off goes on when it is started again.
"""

import sys

from pyspark.sql import SparkSession

import fnsf.bulk

table, output = sys.argv[1:]
session = SparkSession.builder.appName("fnsf").getOrCreate()
pairs = session.read.parquet(table).repartition(200)
report = fnsf.bulk.spark_label(pairs, output, preset="default", threads=2)
report.write.mode("overwrite").parquet(f"{output}-report")
session.read.parquet(f"{output}-report").groupBy("outcome").count().show()
