"""Plant faults in the sources, one at a time, and list those that no test detects.

Run with `python -m tests.mutants --help`, or by `make mutants`.
"""
