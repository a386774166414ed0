"""Training: data sets, architectures, training loop, export (extra `learn`, needs torch)."""
