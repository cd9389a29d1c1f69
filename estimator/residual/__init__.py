"""Diagnose the residual of any model: the columns that explain it, their size, and its location."""
