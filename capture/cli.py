"""`mrbokeh capture`: photographs in, focal stacks with an all-in-focus picture and depth out."""

import typer

from capture.commands import ingest, merge

app = typer.Typer(no_args_is_help=True, help="Photographs to focal stacks: ingest RAW or pictures, then merge them.")
app.command("ingest", help=ingest.HELP)(ingest.ingest_command)
app.command("merge", help=merge.HELP)(merge.merge_command)
