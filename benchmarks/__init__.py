"""Where the figures in README and docs come from; run from the repository's root (docs/benchmarks.md)."""
