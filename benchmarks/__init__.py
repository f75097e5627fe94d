"""Ratios to peers, measured in one run. ``python -m benchmarks NAME`` prints a table and writes NAME.json."""
