"""``python -m tests.fuzz``: run cases of all areas, print how they ended, keep what failed."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from fuzz.runner import main

if __name__ == "__main__":
    sys.exit(main())
