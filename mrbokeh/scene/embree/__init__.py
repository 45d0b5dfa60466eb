"""The backend for any CPU: rays cast by Embree."""
