"""ASAM MDF 4 files: blocks, streams of records, and the CAN frames in them."""
