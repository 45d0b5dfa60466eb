"""What travels through the viewfinder: frames, the newest of them, the header of one on the wire."""
