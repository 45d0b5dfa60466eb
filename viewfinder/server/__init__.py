"""The page's server: who may come in, and what they may ask for."""
