"""All that poolpart relies on in Dask beyond its documented interfaces, by what it touches.

docs/pool-partitions.md has the list: what is used, why, the versions tried, and the test that fails
when it changes. No other module of poolpart reaches into Dask, which a test checks.
"""
