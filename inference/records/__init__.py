"""Whole records: what can be done for all steps at once."""
