"""All code that relies on Dask's undocumented API, grouped by the objects that it accesses.

docs/pool-partitions.md lists what is used and why, the tested versions, and the test that fails if
it changes. A test checks that no other module of poolpart uses private API of Dask, apart from
`deploy`.
"""
