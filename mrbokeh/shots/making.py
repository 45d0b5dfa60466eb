"""A shot from beginning to end: segments that are missing are made by a crew, then joined; what is finished is never made twice."""

from mrbokeh.shots.crew import Crew, Progress
from mrbokeh.shots.parts_folder import PartsFolder
from mrbokeh.shots.segment_task import SegmentTask
from mrbokeh.shots.shot import Shot


def make_shot(shot: Shot, crew: Crew, *, overwrite: bool = False, progress: Progress = lambda _: None) -> str:
    """Returns what became of the sound. Raises InputError where the result exists, or parts of another run do, unless overwrite.

    progress: is told of frames as they are made, and at once of those that an interrupted run left finished.
    """
    shot.target.require_new(shot, overwrite or shot.was_begun)
    folder = PartsFolder.opened(shot, overwrite)
    missing = folder.missing
    progress(sum(segment.frame_count for segment in shot.segments) - sum(segment.frame_count for segment in missing))
    crew.run([SegmentTask(shot, segment, folder.path, crew.threads) for segment in missing], progress)
    note = shot.target.join(shot, folder.path)
    folder.remove()
    return note
