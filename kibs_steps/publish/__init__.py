"""The published files, one module per format; no decision is taken here."""
