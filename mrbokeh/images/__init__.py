"""Pictures as arrays with their colour spaces, and the files that they are read from and written to."""
