"""The books of the parallel trainer: what experience earns, and how old a gradient may be.

Without both, learning depends on the hardware: fast samplers would leave learners behind (fewer
gradient steps in the same experience), and slow learners would send gradients of weights long gone.
"""

from __future__ import annotations


class Earnings:
    """Gradient steps that experience has earned: one for ``update_every`` decisions, as in one
    process, from ``start_steps`` control steps on.

    ahead: gradient steps that experience may be ahead of learning. It is what keeps both sides
    busy; learning is never ahead of experience.
    """

    def __init__(self, start_steps: int, update_every: int, ahead: float) -> None:
        self.start_steps, self.update_every, self.ahead = start_steps, update_every, ahead
        self.steps = 0  # control steps stored
        self.learned_from = 0.0  # decisions stored after the start

    @property
    def earned(self) -> int:
        """Gradient steps that may be done by now."""
        return int(self.learned_from / self.update_every + 1e-9)

    def store(self, steps: int, decisions: int) -> None:
        """Experience has arrived in a buffer: control steps and the decisions made in them."""
        before, self.steps = self.steps, self.steps + steps
        late = min(max(self.steps - self.start_steps, 0), self.steps - before)
        self.learned_from += decisions * late / steps if steps else 0.0

    def may_sample(self, under_way: int, done: int) -> bool:
        """Whether more experience may be asked for.

        under_way: decisions asked for and not yet stored; done: gradient steps done.
        """
        if self.steps < self.start_steps:
            return True
        return (self.learned_from + under_way) / self.update_every - done < self.ahead

    def state_dict(self) -> dict[str, float]:
        return {"steps": self.steps, "learned_from": self.learned_from}

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.steps, self.learned_from = int(state["steps"]), float(state["learned_from"])


class Flights:
    """Gradients that are being formed. The age of one is the number of gradient steps between the
    weights that it was formed with and the step on it; none is older than ``limit``.

    No gradient is thrown away for that: at most ``limit`` + 1 are under way, and one that would
    make another too old waits until that one has landed. The oldest may always land, so the bound
    never blocks (`may_land`).
    """

    def __init__(self, limit: int) -> None:
        self.limit, self.version = limit, 0  # gradient steps done
        self._departed: dict[int, int] = {}  # number of a gradient -> version of its weights

    def __len__(self) -> int:
        return len(self._departed)

    @property
    def may_depart(self) -> bool:
        return len(self._departed) <= self.limit

    def depart(self, number: int) -> None:
        """A gradient is asked for, of the weights as they are."""
        self._departed[number] = self.version

    def may_land(self, number: int) -> bool:
        """Whether the others can still be in time, the oldest first, after a step on this one."""
        others = (at for other, at in self._departed.items() if other != number)
        return all(self.version + 1 + k - at <= self.limit for k, at in enumerate(others))

    def land(self, number: int) -> int:
        """A step is taken on it; returns its age."""
        age = self.version - self._departed.pop(number)
        self.version += 1
        return age

    def lose(self, number: int) -> None:
        """It will not come; it may be asked for again."""
        del self._departed[number]


class Numbers:
    """The numbers of gradients, 1, 2, ...: by them the kinds of a gradient take turns, hence each
    is taken exactly once, and that of a lost one is given out again, first of all."""

    def __init__(self) -> None:
        self._last, self._again = 0, list[int]()

    def due(self, earned: int) -> bool:
        """Whether there is one to give out."""
        return bool(self._again) or self._last < earned

    def take(self) -> int:
        if self._again:
            return self._again.pop(0)
        self._last += 1
        return self._last

    def give_back(self, number: int) -> None:
        self._again.append(number)

    def start_after(self, last: int) -> None:
        """Every number up to this one was taken, none is out."""
        self._last, self._again = last, []
