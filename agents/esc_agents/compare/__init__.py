"""Representations side by side: the grid, its engines, what is measured, the report."""
