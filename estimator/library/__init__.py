"""The library: a drive read from a log or a table, its estimate and its diagnosis, for programs and notebooks."""
