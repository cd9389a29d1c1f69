"""The signal databases shipped with roadload: ``j1939.dbc`` (inputs) and ``roadload.dbc`` (outputs)."""
