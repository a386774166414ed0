"""Accuracy of model sets on fixed test sets that none of them was trained on (docs/benchmarks.md)."""
