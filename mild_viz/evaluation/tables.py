"""A table as text, and how it looks in the terminal, in Markdown and in LaTeX."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.markup import escape
from rich.table import Table

NEWLINE = "\n"


@dataclass(frozen=True)
class TextTable:
    """Cells are plain text, of which a heading may have several lines."""

    caption: str
    header: tuple[str, ...]
    sections: tuple[tuple[tuple[str, ...], ...], ...]
    """Rows, in groups that a line divides."""
    words: frozenset[int] = frozenset({0})
    """Columns of words; the others hold numbers and are aligned to the right."""
    bold: frozenset[tuple[int, int]] = frozenset()
    """Cells to stress: row, counted over all sections, and column."""
    notes: tuple[str, ...] = ()


def to_rich(table: TextTable) -> Table:
    """For the terminal."""
    result = Table(
        title=escape(table.caption), caption=escape(NEWLINE.join(table.notes)) or None, caption_justify="left",
        caption_style="", title_style="bold", title_justify="left",
    )  # fmt: skip
    for column, name in enumerate(table.header):
        result.add_column(escape(name), justify="left" if column in table.words else "right", vertical="top")
    number = 0
    for section in table.sections:
        for row in section:
            cells = [
                f"[bold]{escape(cell)}[/bold]" if (number, column) in table.bold else escape(cell)
                for column, cell in enumerate(row)
            ]
            result.add_row(*cells)
            number += 1
        result.add_section()
    return result


def print_tables(tables: Sequence[TextTable]) -> None:
    """Print to the terminal, in its width; a file or a pipe has none to which cells must be broken."""
    rendered = [to_rich(table) for table in tables]
    console = Console()
    if not console.is_terminal:
        unbounded = console.options.update(width=1000)
        console = Console(width=max(160, *(console.measure(table, options=unbounded).maximum for table in rendered)))
    for table in rendered:
        console.print(table)
        console.print()


def to_markdown(table: TextTable) -> str:
    """A pipe table under its caption; columns are padded, so that it is legible as it stands."""

    def cell(text: str) -> str:
        return text.replace("|", "\\|").replace(NEWLINE, "<br>")

    header = [cell(name) for name in table.header]
    rows = [
        [f"**{cell(text)}**" if (number, column) in table.bold else cell(text) for column, text in enumerate(row)]
        for number, row in enumerate(row for section in table.sections for row in section)
    ]
    widths = [max(3, *(len(row[column]) for row in [header, *rows])) for column in range(len(header))]

    def line(cells: list[str]) -> str:
        padded = [
            text.ljust(width) if column in table.words else text.rjust(width)
            for column, (text, width) in enumerate(zip(cells, widths, strict=True))
        ]
        return f"| {' | '.join(padded)} |"

    rule = ["-" * width if i in table.words else "-" * (width - 1) + ":" for i, width in enumerate(widths)]
    lines = [f"**{table.caption}**", "", line(header), line(rule), *(line(row) for row in rows)]
    for note in table.notes:
        lines += ["", note]
    return NEWLINE.join(lines) + NEWLINE


LATEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "$": r"\$", "&": r"\&", "%": r"\%", "#": r"\#", "_": r"\_",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"$<$", ">": r"$>$", "±": r"$\pm$", "²": r"$^2$",
    "×": r"$\times$", "−": r"$-$",
}  # fmt: skip


def latex_text(text: str) -> str:
    """Plain text as LaTeX; minus signs before numbers, opening quotes and a lone p are set as such."""
    text = re.sub(r"[\\{}$&%#_~^<>±²×−]", lambda match: LATEX[match[0]], text)
    text = re.sub(r"(?<![\w.])([-+])(?=\.?\d)", r"$\1$", text)
    return re.sub(r"(?<!\w)'(?=\w)", "`", re.sub(r"(?<![\w\\])p(?!\w)", "$p$", text))


def to_latex(table: TextTable, label: str) -> str:
    """A `table*` float by booktabs; its notes stand below it in small print."""
    n_lines = max(name.count(NEWLINE) for name in table.header) + 1
    heads = [name.split(NEWLINE) + [""] * (n_lines - 1 - name.count(NEWLINE)) for name in table.header]
    lines = [
        r"\begin{table*}",
        # Sizes that fit the width of a two-column page.
        r"  \centering" + (r"\scriptsize\setlength{\tabcolsep}{2.5pt}" if len(heads) > 7 else r"\footnotesize"),
        f"  \\caption{{{latex_text(table.caption)}}}",
        f"  \\label{{{label}}}",
        f"  \\begin{{tabular}}{{@{{}}{''.join('l' if i in table.words else 'r' for i in range(len(heads)))}@{{}}}}",
        r"    \toprule",
        *(f"    {' & '.join(latex_text(head[i]) for head in heads)} \\\\" for i in range(n_lines)),
    ]
    number = 0
    for section in table.sections:
        lines.append(r"    \midrule")
        for row in section:
            cells = [
                rf"\textbf{{{latex_text(text)}}}" if (number, column) in table.bold else latex_text(text)
                for column, text in enumerate(row)
            ]
            lines.append(f"    {' & '.join(cells)} \\\\")
            number += 1
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    if table.notes:
        lines += ["", r"  \medskip\footnotesize\raggedright"]
        lines += [f"  {latex_text(note)}\\par" for note in table.notes]
    return NEWLINE.join([*lines, r"\end{table*}"]) + NEWLINE
