"""Running viewfinder: sources, tracking, focus, stage and outputs put together."""
