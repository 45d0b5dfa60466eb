"""Single photographs: RAW and pictures decoded to linear light, and what their metadata tells."""
