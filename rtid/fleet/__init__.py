"""Many machines: thousands of traces learned and diagnosed, resumable, merged per machine and type.

jobs      which trace belongs to which machine
learning  one trace: its sums, its verdict; what fails is a row that says so
running   all of them on dask.distributed
archive   the results folder: Parquet by machine, sums, maps
merging   sums of one machine, and what is typical of a type
trend     one quantity of one machine over months
"""
