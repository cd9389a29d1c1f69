"""ASAM MDF 4 files: blocks, streams of records, CAN frames in them."""
