"""The renderers: interchangeable ways to blur layers as a lens does. Import the module of the method you want."""
