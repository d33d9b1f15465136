"""``python -m skillweave``."""

import sys

from skillweave.cli import main

sys.exit(main())
