"""Tables as LaTeX in the style of booktabs, for the default encoding of fonts (OT1).

A document needs ``\\usepackage{booktabs}`` and ``\\usepackage{graphicx}``: the latter's ``\\resizebox`` narrows tables
that are wider than the text. Each file says so in its first line.
"""

from collections.abc import Iterable, Sequence

from rapid.experiments.tables import Entry, Facts, Table, parts

NEEDS = "% Needs \\usepackage{booktabs,graphicx}."
TEXT_WIDTH = 80
"""Characters that a line of text holds, about."""
LONG = 40
"""Characters from which on a cell of words is broken into lines."""

_ESCAPED = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        "&": r"\&",
        "%": r"\%",
        "$": r"\$",
        "#": r"\#",
        "_": r"\_",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        # These four are other signs in OT1: a dash, ¡, ¿ and a closing quotation mark.
        "|": r"\textbar{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        '"': "''",
        "β": r"$\beta$",
        "ε": r"$\varepsilon$",
        "±": r"$\pm$",
        "×": r"$\times$",
        "∞": r"$\infty$",
        "−": "$-$",
        "≤": r"$\leq$",
        "≥": r"$\geq$",
        "≈": r"$\approx$",
        "→": r"$\rightarrow$",
        "²": r"$^2$",
        "·": r"$\cdot$",
        "–": "--",
        "—": "---",
        "…": r"\ldots{}",
    }
)


def latex(table: Table | Facts) -> str:
    """Return a table as LaTeX, everything in it escaped."""
    if isinstance(table, Facts):
        body = [list(row) for row in table.rows]
        columns, wide = _columns(table.columns, body)
        lines = [_line(map(escaped, row)) for row in body]
        heads = table.columns
    else:
        heads = (*table.heads, *table.columns)
        columns = "l" * len(heads)
        lines = [_line([*map(escaped, names), *map(_stacked, entries)]) for names, entries in table.rows]
        cells = [[*map(len, names), *(max(map(len, parts(each))) for each in entries)] for names, entries in table.rows]
        wide = _width([[len(head) for head in heads], *cells]) > TEXT_WIDTH
    inner = [
        rf"\begin{{tabular}}{{{columns}}}",
        r"\toprule",
        _line(map(escaped, heads)),
        r"\midrule",
        *lines,
        r"\bottomrule",
        r"\end{tabular}",
    ]
    if wide:
        inner = [r"\resizebox{\textwidth}{!}{%", *inner[:-1], inner[-1] + "}"]
    notes = [rf"\par\smallskip{{\footnotesize {escaped(note)}\par}}" for note in table.notes]
    label = rf"\label{{table:{table.id}}}"
    caption = rf"\caption{{{escaped(table.caption)}}}"
    return "\n".join([NEEDS, r"\begin{table}[t]", r"\centering", caption, label, *inner, *notes, r"\end{table}"])


def escaped(text: str) -> str:
    """Return text as LaTeX prints it; a new line begins one."""
    return r"\newline ".join(line.translate(_ESCAPED) for line in text.splitlines())


def _line(cells: Iterable[str]) -> str:
    line = " & ".join(cells)
    # After the end of a row, a bracket would be read as a distance and a star as a command.
    return ("{}" if line.startswith(("[", "*")) else "") + line + r" \\"


def _stacked(each: Entry) -> str:
    """Return an entry as lines one above the other: beside each other they would be wider than any page."""
    return r"\begin{tabular}[t]{@{}l@{}}" + r" \\ ".join(map(escaped, parts(each))) + r"\end{tabular}"


def _columns(heads: Sequence[str], body: Sequence[Sequence[str]]) -> tuple[str, bool]:
    """Return the columns of a table of words, and whether they are wider than the text.

    Columns with long cells share what the others leave, by the lengths of their cells.
    """
    lengths = [
        max(len(line) for cell in cells for line in cell.splitlines() or [""])
        for cells in zip(heads, *body, strict=True)
    ]
    broken = [any(len(cell) > LONG or "\n" in cell for cell in cells) for cells in zip(heads, *body, strict=True)]
    short = sum(length + 2 for length, long in zip(lengths, broken, strict=True) if not long)
    share = max(0.4, 0.95 - short / TEXT_WIDTH)
    weights = [min(length, 2 * TEXT_WIDTH) for length, long in zip(lengths, broken, strict=True) if long]
    found = "".join(
        rf"p{{{share * min(length, 2 * TEXT_WIDTH) / sum(weights):.2f}\textwidth}}" if long else "l"
        for length, long in zip(lengths, broken, strict=True)
    )
    return found, short + share * TEXT_WIDTH * any(broken) > TEXT_WIDTH


def _width(lengths: Sequence[Sequence[int]]) -> int:
    """Return the characters of a line: the longest cell of each column and two between them."""
    return sum(max(column) + 2 for column in zip(*lengths, strict=True))
