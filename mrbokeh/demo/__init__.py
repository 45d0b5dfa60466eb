"""The demo: every command of the main job on shipped photographs, and a report of what came out."""
