"""A run goes on only as what it was begun as."""

from pathlib import Path

from mrbokeh.system.errors import InputError
from training.checkpoint import FILE_NAME as CHECKPOINT_NAME
from training.run_folder import FILE_NAME as FACTS_NAME
from training.run_folder import RunFacts, read_facts
from training.settings import FILE_NAME as SETTINGS_NAME
from training.settings import TrainSettings, read_settings

_MAY_DIFFER = ("threads", "device", "cache_mib", "checkpoint_every_s", "sheets")


def require_same_settings(run_folder: Path, settings: TrainSettings) -> None:
    """Raise InputError for other settings than those of the run, except where and how fast it computes and how often it writes."""
    if _begun(run_folder, SETTINGS_NAME):
        _require_same(run_folder, "settings", read_settings(run_folder), settings, _MAY_DIFFER)


def require_same_data(run_folder: Path, facts: RunFacts) -> None:
    """What a run has seen cannot be held out later."""
    if _begun(run_folder, FACTS_NAME):
        _require_same(run_folder, "data", read_facts(run_folder), facts, ("lens", "commit"))


def _begun(run_folder: Path, name: str) -> bool:
    return (run_folder / CHECKPOINT_NAME).exists() and (run_folder / name).exists()


def _require_same(run_folder: Path, what: str, before: object, now: object, may_differ: tuple[str, ...]) -> None:
    differing = [name for name, value in vars(now).items() if vars(before)[name] != value and name not in may_differ]
    if differing:
        raise InputError(
            f"{run_folder} holds a run with other {what} ({', '.join(differing)}): give another --out, or --overwrite to start again"
        )


def remove_unfinished(run_folder: Path) -> None:
    """Remove what a killed run was writing: files get their name when they are whole."""
    for path in run_folder.rglob(".*.part.*"):
        path.unlink()
