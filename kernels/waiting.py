"""The C of a batch function whose loops wait: columns go round such a loop with full lanes.

    columns, W at a time      |   the record of each column that waits, and lists of these
    ==========================|==================================================================
    segment 0                 |
       |----- want loop 0 ----+-> list of loop 0: W at a time; one that ends makes room for the next
    segment 1                 |   segment 1 of the columns that have gone round
       |----- want loop 1 ----+-> list of loop 1, with those from segment 1 that want it
    segment 2                 |   segment 2 of all these
       |                      |      |
    results                   |   results

On the left (`straight`) columns go all the way in registers: most columns wait for nothing. A column that needs a loop
leaves this path, and stores its live values in a record (`kernels.segments`). On the right a segment loads the values
that it reads from W records, computes, stores, and appends the columns that need the next loop to the list of that
loop. Loops run in the function's order, each until its list is empty, so only the last vectors of a list have idle
lanes. Chunks are long to keep idle lanes few.

The body of a loop may have loops that wait, too. Then the body is cut in the same way, and all columns that go round
the outer loop go through its segments together, once for each turn. The body of any other loop is one function, W lanes
at a time.

Each column's results depend on that column alone: their bits are the same in any order, in any batch, and with any
number of lanes.
"""

from collections.abc import Sequence

from kernels.calls import ONCE
from kernels.operations.expressions import MASK, NUMBER
from kernels.parts import LETTER, Part
from kernels.segments import Frame, Placed, Records, Waits
from kernels.text import LOOPS, Body, declared

INCLUDE = '#include "waiting.h"'  # `kernels.compiled.sources` replaces it, so that recordings do not hold it
CHUNK = 2048  # columns that are processed together
MEMORY = {"double": "double", "bool": "uint8_t", "long": "int64_t", "float": "float"}
AT = {"n": "NUMBERS", "m": "TRUTHS"}  # parts of a record by the beginning of a place in it
LANES = "for (int lane = 0; lane < W; ++lane) {"
RECORDS = [
    "    for (int first = 0; first < count; first += W) {",
    "        struct record *at[W];",
    "        const M on = YES;",
    "        gather(at, work, list, first, count);",
]


def waiting(body: Body) -> str:
    """Returns the C of a function for a batch, NAME_batch as in `kernels.compiled.batch`; "": no loop waits."""
    if not body.waits:
        return ""
    records = Records()
    frame = Frame(records, body)
    numbers, truths = records.sizes[NUMBER], records.sizes[MASK]
    sizes = {"NUMBERS": numbers, "TRUTHS": truths, "LOOPS": frame.last, "CHUNK": CHUNK}
    lines = [*functions(frame), *straight(frame), *batch(frame)]
    return "\n".join([*(f"#define {name} {max(1, n)}" for name, n in sizes.items()), INCLUDE, *lines])


def functions(frame: Frame) -> list[str]:
    """Returns the C functions of a frame's loops and segments, and tables of them."""
    lines = [line for each in frame.loops for line in loop(each)]
    first = 0 if frame.owner else 1
    lines += [line for s in range(first, frame.last + 1) for line in segment(frame, s)]
    segments = ["0"] * first + [f"segment_{number}" for number in frame.numbers[first:]]
    loops = [f"loop_{each.number}" for each in frame.loops]
    number = frame.numbers[0]
    return [
        *lines,
        f"static segment *const SEGMENTS_{number}[] = {{{', '.join(segments)}}};",
        f"static loop *const LOOPS_{number}[] = {{{', '.join(loops)}}};",
        "",
    ]


def loop(waits: Waits) -> list[str]:
    """Returns the C function that has the columns of a list go round a loop."""
    head = [f"static void loop_{waits.number}(struct work *work, const int *list, int count)", "{"]
    if not waits.body:
        return [*head, *(once(waits) if waits.it.most == ONCE else refilled(waits)), "}", ""]
    number, last = waits.body.numbers[0], waits.body.last
    most = "1" if waits.it.most == ONCE else waits.it.most
    call = f"    go_round(work, list, count, SEGMENTS_{number}, LOOPS_{number}, {last}, {most});"
    return [*functions(waits.body), *head, call, "}", ""]


def once(waits: Waits) -> list[str]:
    """Returns the statements that call a function for the columns of a list."""
    callee = waits.it.callee
    return [
        *RECORDS,
        *(f"        {line}" for line in declared("", callee.inputs)),
        *(f"        {element} = {load(place)};" for element, place in waits.arguments),
        *(f"        {line}" for line in called(waits)),
        *store([(place, f"next_{element}") for element, place in waits.results]),
        "    }",
    ]


def refilled(waits: Waits) -> list[str]:
    """Returns the statements of a loop: a column that ends is stored, and the list's next one takes its lane."""
    callee, goes_on = waits.it.callee, waits.it.callee.outputs[-1].name
    state = list(zip(waits.arguments, waits.results, strict=False))
    return [
        "    struct record *at[W];",
        "    int turns[W] = {0};",
        "    int next = 0;",
        "    M on = NO;",
        *(f"    {x.array()} = {{{{0}}}};" for x in callee.inputs if x.size),
        "    for (;;) {",
        f"        {LANES}",
        "            if (!on[lane] && next < count) {",
        "                at[lane] = &work->records[list[next]];",
        "                ++next;",
        *(f"                {element}[lane] = at[lane]->{place};" for element, place in waits.arguments),
        "                turns[lane] = 0;",
        "                on[lane] = -1;",
        "            }",
        "        }",
        "        if (!ANY(on)) {",
        "            return;",
        "        }",
        *(f"        {line}" for line in called(waits)),
        *(f"        {before} = next_{after};" for (before, _), (after, _) in state),
        f"        {LANES}",
        f"            if (on[lane] && (++turns[lane] == {waits.it.most} || !next_{goes_on}[0][lane])) {{",
        *(f"                at[lane]->{place} = {before}[lane];" for (before, _), (_, place) in state),
        "                on[lane] = 0;",
        "            }",
        "        }",
        "    }",
    ]


def called(waits: Waits) -> list[str]:
    """Returns the statements that call a loop's body, with arrays of its arguments' names."""
    callee = waits.it.callee
    given = [x.name for x in callee.inputs if x.size] + [f"next_{y.name}" for y in callee.outputs if y.size]
    return [*declared("next_", callee.outputs), f"{callee.name}({', '.join(['on', *given])});"]


def segment(frame: Frame, s: int) -> list[str]:
    """Returns the C function of a segment; the last one stores the loop's next state, or the results."""
    number, body = frame.numbers[s], frame.body
    lines = [*loads(frame, s), *computed(frame, s)]
    if s < frame.last:
        lines += store(frame.stored(s))
        wants = body.operand(frame.loops[s].it.alive, MASK)
    elif frame.owner:
        texts = [(kind, body.operand(value, kind)) for _, value, kind in body.stores]
        lines += [f"        const {LETTER[k]} next_{j} = {text};" for j, (k, text) in enumerate(texts)]
        lines += store([(place, f"next_{j}") for j, (_, place) in enumerate(frame.owner.results)])
        wants = "NO" if frame.owner.it.most == ONCE else f"next_{len(texts) - 1}"
    else:
        parts = outputs(frame, early=False)
        lines += [f"        {line}" for line in filled(frame, parts)] + scattered(frame, parts)
        wants = "NO"
    return [
        f"static int segment_{number}(struct work *work, const int *list, int count, int *to, int there)",
        "{",
        *RECORDS,
        *lines,
        f"        there = append(to, there, list, first, count, {wants});",
        "    }",
        "    return there;",
        "}",
        "",
    ]


def computed(frame: Frame, s: int) -> list[str]:
    """Returns the statements of a segment."""
    body = frame.body
    own = [e for e in body.needed if frame.segment[e.index] == s and e.operation != "waiting"]
    return [line for each in own for line in body.line(each, 2).split("\n") if line]


def loads(frame: Frame, s: int) -> list[str]:
    """Returns the statements that load what a segment reads from records: elements of arrays, and single numbers."""
    body, lines = frame.body, list[str]()
    loaded = {each.index: each for each in frame.used(s) if frame.is_loaded(each, s)}
    texts = [(body.operand(each), each) for _, each in sorted(loaded.items())]
    arrays = declared("", body.function.inputs)
    for each in body.needed:
        if each.operation in (*LOOPS, "call"):
            arrays += declared(f"t{each.index}_", body.called.by_name[each.arguments[0]].outputs)
    wanted = {text.split("[")[0] for text, _ in texts if "[" in text}
    lines += [line for line in arrays if line.split()[1].split("[")[0] in wanted]
    for text, each in texts:
        start = "" if "[" in text else f"const {LETTER[each.kind]} "
        lines.append(f"{start}{text} = {load(frame.places[each.index])};")
    return [f"        {line}" for line in lines]


def load(place: str) -> str:
    """Returns the expression that reads a place of W records."""
    return f"{AT[place[0]]}_AT({place[2:-1]})"


def store(kept: Sequence[Placed], wants: str = "") -> list[str]:
    """Returns the statements that store vectors in places of W records, or only of the records in `wants`."""
    texts = [(place, text if "(" not in text else f"({text})") for place, text in kept]
    lines = [f"at[lane]->{place} = {text}[lane];" for place, text in texts]
    if wants:
        lines = [f"if ({wants}[lane]) {{", *(f"    {line}" for line in lines), "}"]
    return [f"        {LANES}", *(f"            {line}" for line in lines), "        }"] if kept else []


def outputs(frame: Frame, early: bool) -> list[Part]:
    """Returns the results that are known before the first loop, or the others."""
    return [y for y in frame.body.outputs if frame.is_early(y.name) == early]


def filled(frame: Frame, parts: Sequence[Part]) -> list[str]:
    """Returns the statements that fill arrays of results."""
    names = {y.name for y in parts}
    own = [each for each in frame.body.stores if each[0].split("[")[0] in names]
    return [*declared("", parts), *(f"{place} = {frame.body.operand(v, kind)};" for place, v, kind in own)]


def scattered(frame: Frame, parts: Sequence[Part]) -> list[str]:
    """Returns the statements that store results of the columns of W records."""
    lines = []
    for i, y in enumerate(frame.body.outputs):
        for k in range(y.size) if y in parts else ():
            value = f"{y.name}[{k}][lane]" + (" != 0" if y.values == MASK else "")
            at = f"(({MEMORY[y.kind]} *)work->out[{i}])[{k} * work->out_step[{i}] + at[lane]->column]"
            lines.append(f"            {at} = {value};")
    return [f"        {LANES}", *lines, "        }"]


def straight(frame: Frame) -> list[str]:
    """Returns `straight`: W columns go through all segments; a column that needs a loop leaves."""
    lines, body = list[str](), frame.body
    for s in range(frame.last + 1):
        lines += [line[4:] for line in computed(frame, s)]
        parts = outputs(frame, early=s == 0) if s in (0, frame.last) else []
        lines += [f"    {line}" for line in filled(frame, parts)]
        for y in parts:
            i = body.outputs.index(y)
            to = f"work->out[{i}], k * work->out_step[{i}] + column, lanes"
            lines.append(f"    for (int k = 0; k < {y.size}; ++k) {{ store_{y.kind}({to}, {y.name}[k]); }}")
        if s < frame.last:
            start = f"t{frame.waits[s].index}_"
            lines += [
                f"    wants = AND(on, {body.operand(frame.loops[s].it.alive, MASK)});",
                "    if (ANY(wants)) {",
                f"        leave(work, {s}, wants, column, at);",
                *store(frame.live(s), "wants"),
                "        on = AND(on, NOT(wants));",
                "        if (!ANY(on)) {",
                "            return;",
                "        }",
                "    }",
                *(f"    {line}" for line in body.begun(start, frame.loops[s].it)),
            ]
    given = [f"const {x.array()}" for x in body.inputs]
    head = f"static void straight({', '.join(['struct work *work', 'long column', 'long lanes', 'M on', *given])})"
    return [head, "{", "    struct record *at[W];", "    M wants;", *lines, "}", ""]


def batch(frame: Frame) -> list[str]:
    """Returns the function of a range of columns; in C it returns 1 if memory is missing."""
    inputs, number = frame.body.inputs, frame.numbers[0]
    loads = [
        f"for (int k = 0; k < {x.size}; ++k) {{ "
        f"{x.name}[k] = load_{x.kind}(in[{i}], k * in_step[{i}] + column, lanes); }}"
        for i, x in enumerate(inputs)
    ]
    return [
        f"long {frame.body.function.name}_batch(long first, long last, const void *const *in, const long *in_step,",
        "    void *const *out, const long *out_step, long times)",
        "{",
        "    struct work *const work = malloc(sizeof *work);",
        "    if (!work) {",
        "        return 1;",
        "    }",
        "    work->out = out;",
        "    work->out_step = out_step;",
        "    for (long start = first; start < last; start += CHUNK) {",
        "        const long end = (start + CHUNK < last) ? start + CHUNK : last;",
        "        work->count = 0;",
        "        memset(work->waits, 0, sizeof work->waits);",
        "        for (long column = start; column < end; column += W) {",
        "            const long lanes = end - column;",
        "            M on;",
        *(f"            {line}" for line in declared("", inputs)),
        f"            {LANES}",
        "                on[lane] = (lane < lanes) ? -1 : 0;",
        "            }",
        *(f"            {line}" for line in loads),
        f"            straight({', '.join(['work', 'column', 'lanes', 'on', *(x.name for x in inputs)])});",
        "        }",
        f"        go_on(work, SEGMENTS_{number}, LOOPS_{number});",
        "    }",
        "    free(work);",
        "    return 0;",
        "}",
        "",
    ]
