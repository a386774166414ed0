"""`python -m kibs_steps.publish.viewer`."""

from kibs_steps import cli
from kibs_steps.publish.viewer import main

cli.run(main, pandas=False)
