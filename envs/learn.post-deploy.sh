#!/usr/bin/env bash
# Runs in the new environment, in the folder where snakemake was started: the repository.
pip install --no-deps .
