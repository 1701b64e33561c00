"""Environments of a run, and who drives in them."""
