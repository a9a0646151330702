"""``python -m hipsta_bids.cli`` is the command ``hipsta-bids``."""

import sys

from hipsta_bids.cli.main import main

sys.exit(main())
