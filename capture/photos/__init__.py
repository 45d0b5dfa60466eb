"""One photograph: decoding RAW and pictures to linear light, and what its metadata tells."""
