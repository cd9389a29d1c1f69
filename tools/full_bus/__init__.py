"""Parts of the daemon's benchmark: a stand-in for a SocketCAN bus, its traffic, and the programs under test."""
