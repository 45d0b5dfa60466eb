"""Studio: objects placed in one photograph on a page, with the command line that makes the same picture."""
