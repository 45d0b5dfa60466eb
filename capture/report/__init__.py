"""Reports on focal stacks: what proves or disproves them, measured and put on one page."""

HTML_NAME = "report.html"
