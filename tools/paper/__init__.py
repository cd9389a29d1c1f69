"""The paper's tables and figures, made with the program's own model, likelihood and random walk."""
