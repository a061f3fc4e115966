"""A function cut at its loops that wait, see `kernels.waiting`: what each segment computes, loads and stores.

A recorded function has no branches. So n loops that wait cut it into n + 1 segments: the part before the first loop,
the part that needs the results of the first loop, and so on. A value that a later segment reads, or that a loop
receives, is live between them, as compilers call it. It has a place in a column's record, among numbers n or truth
values m.
"""

from collections.abc import Iterator, Sequence
from itertools import count

from kernels.calls import result
from kernels.operations.expressions import MASK, NUMBER, Expression, Value
from kernels.parts import Part
from kernels.text import LOOPS, Body

Placed = tuple[str, str]  # a place, and the stored value's name in C


class Records:
    """Allocates the places of values in a record, and numbers of segments and loops."""

    def __init__(self) -> None:
        self.sizes = {NUMBER: 0, MASK: 0}
        self.segments, self.loops = count(), count()

    def place(self, kind: str) -> str:
        """Returns a new place for a value of this kind."""
        self.sizes[kind] += 1
        return f"{kind[0]}[{self.sizes[kind] - 1}]"


class Waits:
    """Describes a loop that waits.

    Attributes:
        it: the loop (`kernels.text.Repeated`); number: of its C function.
        state, given: places of its body's arguments, by part; results replace the state.
        arguments, results: elements of the body's arguments and of the next state, each with its place.
        body: its segments; None: it is one function.
    """

    def __init__(self, frame: "Frame", each: Expression) -> None:
        self.it, self.number = frame.body.repeated(each), next(frame.records.loops)
        self.state = [[frame.records.place(y.values) for _ in range(y.size)] for y in self.it.state]
        values = iter(self.it.values)
        self.given = [[frame.kept(next(values), x.values) for _ in range(x.size)] for x in self.it.given]
        passed = self.state if self.it.passed else []
        self.arguments = placed(self.it.callee.inputs, [*passed, *self.given])
        self.results = placed(self.it.state, self.state)
        body = Body(self.it.callee, frame.body.called)
        self.body = Frame(frame.records, body, self) if body.waits else None

    def begin(self, body: Body) -> list[Placed]:
        """Returns what a column stores when it comes to the loop: the initial state, and literal arguments."""
        values = [*self.it.start, *(v for v in self.it.values if not isinstance(v, Expression))]
        places = [place for part in self.state for place in part]
        given = [place for part in self.given for place in part]
        places += [p for p, v in zip(given, self.it.values, strict=True) if not isinstance(v, Expression)]
        return [
            (p, body.operand(v, MASK if p[0] == "m" else None)) for p, v in zip(places, values, strict=True)
        ]


class Frame:
    """Holds a function cut into segments: the function of a batch, or the body of a loop that waits.

    Attributes:
        owner: the loop whose body it is; None: it is all of a batch.
        waits, loops: the loops that wait, as expressions and as `Waits`; last: the number of the last segment.
        segment: by expression the first segment in which it is known; read: the last one that computes with it.
        given: by expression the last loop that receives it.
        places: by expression, where its value is stored; numbers: of the segments in C.
    """

    def __init__(self, records: Records, body: Body, owner: Waits | None = None) -> None:
        self.records, self.body, self.owner = records, body, owner
        if any(each.varies for each in body.needed):
            raise NotImplementedError(
                "an axis that is looped over, in a function with loops that wait, cannot be printed as C"
            )
        self.waits = body.waits
        self.segment, self.last = segments(body.needed, self.waits), len(self.waits)
        at = dict(owner.arguments) if owner else {}
        inputs = [each for each in body.needed if each.operation == "input"]
        self.places = {each.index: at[each.arguments[0]] for each in inputs if each.arguments[0] in at}
        self.literals, self.given = dict[tuple[str, str], str](), dict[int, int]()
        self.loops: list[Waits] = []
        for i, each in enumerate(self.waits):
            self.given |= {v.index: i for v in body.repeated(each).values if isinstance(v, Expression)}
            self.loops.append(Waits(self, each))
            self.places |= self.results(each, self.loops[i])
        self.read = {each.index: s for s in range(self.last + 1) for each in self.used(s)}
        for each in body.needed:
            if is_value(each) and self.read.get(each.index, -1) > self.segment[each.index]:
                self.kept(each, each.kind)
        self.numbers = [next(records.segments) for _ in range(self.last + 1)]

    def results(self, each: Expression, loop: Waits) -> dict[int, str]:
        """Returns the places of a loop's results."""
        sizes = [(y, k) for y in loop.it.state for k in range(y.size)]
        at = {result(each, y, k): place for (y, k), (_, place) in zip(sizes, loop.results, strict=True)}
        own = [e for e in self.body.needed if e.operation == "result" and e.arguments[0] is each]
        return {e.index: at[e.arguments[1]] for e in own}

    def kept(self, value: Value, kind: str) -> str:
        """Returns the place of a value, which is stored once."""
        if isinstance(value, Expression):
            if value.index not in self.places:
                self.places[value.index] = self.records.place(kind)
            return self.places[value.index]
        key = self.body.operand(value, kind), kind
        if key not in self.literals:
            self.literals[key] = self.records.place(kind)
        return self.literals[key]

    def used(self, s: int) -> list[Expression]:
        """Returns the values with which a segment computes, decides and begins its next loop, or which it returns."""
        values: list[object] = []
        for each in self.body.needed:
            if self.segment[each.index] == s and each.operation not in ("result", "waiting"):
                values += each.arguments
        if s < self.last:
            values += [self.loops[s].it.alive, *self.loops[s].it.start]
        else:
            values += [value for place, value, _ in self.body.stores if not self.is_early(place)]
        return [each for each in values if isinstance(each, Expression)]

    def is_early(self, place: str) -> bool:
        """Checks whether a result of a batch, of which `place` is an element, is known before the first loop."""
        own = [value for at, value, _ in self.body.stores if at.split("[")[0] == place.split("[")[0]]
        known = all(not isinstance(v, Expression) or self.segment[v.index] == 0 for v in own)
        return known and self.owner is None

    def is_loaded(self, each: Expression, s: int) -> bool:
        """Checks whether a segment reads a value from records instead of computing it."""
        is_argument = each.operation == "input" and self.owner is not None
        is_result = each.operation == "result" and each.arguments[0].operation == "waiting"
        return is_value(each) and (self.segment[each.index] < s or is_argument or is_result)

    def stored(self, s: int) -> list[Placed]:
        """Returns what a segment stores: values that are read later, and what the loop after it begins with."""
        own = [e for e in self.body.needed if e.index in self.places and self.segment[e.index] == s]
        found = [(self.places[e.index], self.body.operand(e)) for e in own if not self.is_loaded(e, s)]
        return found + self.loops[s].begin(self.body)

    def live(self, s: int) -> list[Placed]:
        """Returns what a column stores when it leaves `straight` for the loop after segment s."""
        own = [e for e in self.body.needed if e.index in self.places and self.segment[e.index] <= s]
        later = [e for e in own if self.read.get(e.index, -1) > s or self.given.get(e.index, -1) >= s]
        return [(self.places[e.index], self.body.operand(e)) for e in later] + self.loops[s].begin(self.body)


def segments(needed: Sequence[Expression], waits: Sequence[Expression]) -> dict[int, int]:
    """Returns by expression the first segment in which it is known."""
    order, found = {each.index: i for i, each in enumerate(waits)}, dict[int, int]()
    for each in needed:
        own = max((found[a.index] for a in each.arguments if isinstance(a, Expression)), default=0)
        if each.operation == "waiting":
            own = order[each.index]
        elif each.operation == "result" and each.arguments[0].index in order:
            own = order[each.arguments[0].index] + 1
        found[each.index] = own
    return found


def is_value(each: Expression) -> bool:
    """Checks whether an expression is a value, not a call, a loop or the mask `on`."""
    return each.operation not in ("call", *LOOPS) and each.arguments[:1] != ("on",)


def placed(parts: Sequence[Part], places: Sequence[Sequence[str]]) -> list[tuple[str, str]]:
    """Returns elements of parts, and their places."""
    pairs: Iterator[tuple[Part, Sequence[str]]] = zip(parts, places, strict=True)
    return [(f"{part.name}[{k}]", place) for part, own in pairs for k, place in enumerate(own)]
