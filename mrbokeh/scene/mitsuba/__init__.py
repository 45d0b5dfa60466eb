"""The backend that traces paths, by Mitsuba."""
