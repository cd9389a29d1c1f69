"""A virtual machine with SocketCAN, for hosts whose kernel has none."""
