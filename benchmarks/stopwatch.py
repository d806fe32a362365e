"""CPU seconds of the parts of a program; a part does not include the parts inside it.

Nothing but the standard library: it also runs where another package is measured.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable
from typing import Any

REST = "loop, logging"


class Stopwatch:
    """``spent``: part -> CPU seconds since the last `reset`; outside of all parts it is REST.

    ``calls``: part -> how often it was entered since then.
    """

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self.calls: Counter[str] = Counter()
        self.parts = [REST]
        self._last = time.process_time()

    def lap(self) -> None:
        """Gives the time since the last lap to the part that is running."""
        now = time.process_time()
        self.spent[self.parts[-1]] += now - self._last
        self._last = now

    def reset(self) -> None:
        self.lap()
        self.spent.clear()
        self.calls.clear()

    def time(self, part: str, owner: Any, method: str) -> None:
        """From now on a call of this method of this object is that part."""
        setattr(owner, method, self._timed(part, getattr(owner, method)))

    def _timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any, **keywords: Any) -> Any:
            self.lap()
            self.parts.append(part)
            self.calls[part] += 1
            try:
                return function(*arguments, **keywords)
            finally:
                self.lap()
                self.parts.pop()

        return timed
