"""The commands of `mrbokeh train`: fit, export, evaluate, ablate, doctor."""

import typer

from training.commands.ablate import ablate_command
from training.commands.evaluate import doctor_command, evaluate_command
from training.commands.export import export_command
from training.commands.fit import fit_command

app = typer.Typer(no_args_is_help=True, help="Train a network that reproduces the blur of one lens.")
app.command("fit")(fit_command)
app.command("export")(export_command)
app.command("evaluate")(evaluate_command)
app.command("ablate")(ablate_command)
app.command("doctor")(doctor_command)
