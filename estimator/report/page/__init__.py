"""The parts of the page: plots, figures, tables, and its style sheet."""
