"""Importing this module makes collections of garbage rarer, in a command and in its workers.

With Python's threshold, collections take a tenth of the time of all imports.
"""

from __future__ import annotations

import gc

gc.set_threshold(50_000)
