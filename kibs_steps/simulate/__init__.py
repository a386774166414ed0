"""Simulated cities with exact truth: geometry, light, camera (numpy only)."""
