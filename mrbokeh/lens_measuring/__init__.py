"""Lenses measured from focal stacks (`fitting`) and from one photograph (`matching`)."""
