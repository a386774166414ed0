"""Puts this folder on the path, so that tests of every step can import `toy`."""
