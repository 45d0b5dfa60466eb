"""What proves or disproves a focal stack, measured and put on one page."""

HTML_NAME = "report.html"
