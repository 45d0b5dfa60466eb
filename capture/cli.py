"""`mrbokeh capture`: photographs in, focal stacks with an all-in-focus picture and depth out."""

import typer

from capture.commands import cameras, dataset, depth, ingest, matchmove, merge, plan, poses, process, report, scale, shoot, solve

app = typer.Typer(
    no_args_is_help=True, help="Photographs to focal stacks: shoot, ingest, merge, poses, scale, depth, report, dataset; solve."
)
app.command("plan", help=plan.HELP)(plan.plan_command)
app.command("cameras", help=cameras.HELP)(cameras.cameras_command)
app.command("shoot", help=shoot.HELP)(shoot.shoot_command)
app.command("ingest", help=ingest.HELP)(ingest.ingest_command)
app.command("merge", help=merge.HELP)(merge.merge_command)
app.command("poses", help=poses.HELP)(poses.poses_command)
app.command("matchmove", help=matchmove.HELP)(matchmove.matchmove_command)
app.command("scale", help=scale.HELP)(scale.scale_command)
app.command("solve", help=solve.HELP)(solve.solve_command)
app.command("depth", help=depth.HELP)(depth.depth_command)
app.command("dataset", help=dataset.HELP)(dataset.dataset_command)
app.command("report", help=report.HELP)(report.report_command)
app.command("process", help=process.HELP)(process.process_command)
