"""Server of the page: who may come in, and what they may ask for."""
