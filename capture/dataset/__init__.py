"""Focal stacks as a data set for training: manifest, hashes, split, exclusion masks."""
