"""What can be kept and shown of an estimate: draws, tables, pictures."""
