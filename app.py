"""`python app.py`: the dashboard on the built-in demo set; the options are those of `mild-viz app`."""

import sys

from mild_viz.cli import main_app

if __name__ == "__main__":
    sys.exit(main_app())
