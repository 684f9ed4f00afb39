"""Parts of an HTML page: sections, tables, and pictures as SVG in the colours of the page. The
style sheet (light, dark and print) and the section "How to read this" are those of all reports.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape
from io import StringIO
from typing import TYPE_CHECKING

from driftfit.show.axes import BLUE, GREY, RED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftfit.run.result import Track


IMAGE_SAMPLES = 3000
"""In longer records the points of pictures are an image inside the SVG."""

UNSPLIT_ROWS = 12
"""A table with at most this many rows is not split between two printed pages."""

INK = "#1b1b1b"
"""Colour of text and axes while a picture is drawn; replaced by the text colour of the page."""

COLOURS = {INK: "ink", BLUE: "blue", RED: "red", GREY: "grey", "#b0b0b0": "rule"}


def document(heading: str, sections: Sequence[str]) -> str:
    """Combine sections into one page."""
    body = "\n".join(sections)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(heading)}</title><style>{STYLE}</style></head>\n<body><main>\n{body}\n</main></body></html>\n"
    )


def section(title: str, body: str) -> str:
    return f"<section><h2>{escape(title)}</h2>\n{body}</section>"


def table(caption: str, heads: tuple[str, ...], rows: Sequence[tuple[str, ...]], words: Sequence[int] = ()) -> str:
    """A table; cells are HTML already, and ``words`` are the columns aligned as text, besides the first."""
    kinds = [' class="words"' if column in words else "" for column in range(len(heads))]

    def line(tag: str, cells: tuple[str, ...]) -> str:
        return "".join(f"<{tag}{kind}>{cell}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))

    top, body = line("th", heads), "".join(f"<tr>{line('td', row)}</tr>" for row in rows)
    short = " short" if len(rows) <= UNSPLIT_ROWS else ""
    return (
        f'<div class="wide{short}"><table><caption>{escape(caption)}</caption>'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def opening(sentences: Iterable[str]) -> str:
    """The sentences with which a page begins."""
    return f'<div class="verdict">{"".join(f"<p>{escape(one)}</p>" for one in sentences)}</div>'


def points(items: Sequence[str]) -> str:
    """A list, of HTML; nothing for no items."""
    return f"<ul>{''.join(f'<li>{one}</li>' for one in items)}</ul>" if items else ""


def facts(pairs: Iterable[tuple[str, str]]) -> str:
    """Names with what is known of them; what is empty is left out."""
    each = (f"<dt>{escape(name)}</dt><dd>{escape(value)}</dd>" for name, value in pairs if value)
    return f"<dl>{''.join(each)}</dl>"


def of_all(count: int, listed: int) -> str:
    """What a caption says of a table that lists only the first of its rows."""
    return f" The first {listed} of {count}." if count > listed else ""


def picture(figure: Figure, run: Track, caption: str) -> str:
    return f"<figure>{svg(figure, len(run) > IMAGE_SAMPLES)}<figcaption>{escape(caption)}</figcaption></figure>\n"


def svg(figure: Figure, thin: bool = False) -> str:
    """A figure as SVG text in the colours of the page; ``thin`` draws the samples as an image."""
    import matplotlib

    for axis in figure.axes:
        _inked(axis)
        for artist in (*axis.lines, *axis.collections, *axis.patches):
            artist.set_rasterized(thin)
    figure.patch.set_alpha(0.0)
    text = StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": figure.axes[0].get_ylabel() or "driftfit"}):
        figure.savefig(text, format="svg", dpi=110, metadata={"Date": None, "Creator": None}, transparent=True)
    drawn = text.getvalue()
    drawn = drawn[drawn.index("<svg") :]
    drawn = re.sub(r"<metadata>.*?</metadata>", "", drawn, flags=re.S)
    for colour, name in COLOURS.items():
        drawn = drawn.replace(colour, f"var(--{name})")
    return re.sub(r"font: ([\d.]+)px [^;\"]*", r"font: \1px system-ui, sans-serif", drawn)


def _inked(axis: object) -> None:
    """Give text, ticks and frame of an axis the text colour of the page."""
    from matplotlib.axes import Axes

    assert isinstance(axis, Axes)
    for side in axis.spines.values():
        side.set_edgecolor(INK)
        side.set_linewidth(0.6)
    axis.tick_params(colors=INK, which="both")
    legend = axis.get_legend()
    titles = [axis.title, axis._left_title] if hasattr(axis, "_left_title") else [axis.title]
    words = [word for side in (axis.xaxis, axis.yaxis) for word in (side.label, side.get_offset_text())]
    for word in (*titles, *words, *axis.texts, *(legend.get_texts() if legend else ())):
        if word.get_color() in ("black", "k", "#000000"):
            word.set_color(INK)


STYLE = """
:root { color-scheme: light dark; --page: #ffffff; --ink: #1d2126; --soft: #5d6670; --rule: #d9dee3; --card: #f5f7f9;
  --blue: #1f5fa8; --red: #c23b22; --grey: #8a8a8a; --good: #23713b; }
@media (prefers-color-scheme: dark) { :root { --page: #14171a; --ink: #e6e9ec; --soft: #9aa4ae; --rule: #343b42;
  --card: #1d2226; --blue: #6aa9f0; --red: #f0806a; --grey: #8f979e; --good: #6cc48a; } }
@page { size: A4; margin: 15mm; }
body { margin: 0; background: var(--page); color: var(--ink);
  font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 64rem; margin: 0 auto; padding: 1.5rem; }
h1 { font-size: 1.6rem; margin: 0 0 .2rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: 1.4rem 0 .3rem; }
.soft, figcaption, caption { color: var(--soft); font-size: .88rem; }
.verdict { background: var(--card); border-left: .35rem solid var(--blue); padding: .8rem 1.1rem; margin: 1rem 0; }
.verdict p { margin: .3rem 0; } .verdict p:first-child { font-size: 1.15rem; font-weight: 600; }
.wide { overflow-x: auto; } table { border-collapse: collapse; width: 100%;
  margin-bottom: 1rem; font-variant-numeric: tabular-nums; }
caption { text-align: left; padding-bottom: .3rem; caption-side: top; }
td { font-size: .94rem; }
th, td { padding: .3rem .5rem; text-align: right; border-bottom: 1px solid var(--rule); white-space: nowrap; }
th { font-weight: 600; font-size: .88rem; } th:first-child, td:first-child, .words { text-align: left; }
.bad { color: var(--red); font-weight: 600; } .good { color: var(--good); }
figure { margin: 1rem 0; } figure svg { width: 100%; height: auto; display: block; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .2rem 1.2rem; margin: .5rem 0; }
dt { color: var(--soft); } dd { margin: 0; overflow-wrap: anywhere; } li { margin: .2rem 0; }
@media print { :root { --page: #ffffff; --ink: #000000; --soft: #444444; --rule: #bbbbbb; --card: #f4f4f4;
  --blue: #1f5fa8; --red: #c23b22; --grey: #777777; --good: #23713b; } html { font-size: 11px; }
  figure, tr, li, .verdict, .short, .one { break-inside: avoid; }
  h2, h3 { break-after: avoid; } main { max-width: none; padding: 0; }
  .wide { overflow: visible; } th, td { white-space: normal; } }
"""

READING = """<p>The output is described as a sum of regressors times parameters. The parameters are estimated sample
by sample: at every time the estimate uses the past only, and the band shows how accurate it was then.</p>
<ul><li><b>Do the parameters move?</b> This is a test of constant parameters that is valid with outliers, changing noise
and changing inputs. A small p means that constant parameters would hardly produce such a record.</li>
<li><b>Does tracking them pay?</b> The table compares the error of predicting the next sample with three simple
methods: repeating the last value (persistence), one set of constants fitted to all of the past (constant LS), and a
small constant dynamic model (constant ARX). A p below 0.05 means that this run is better by more than chance.</li>
<li><b>Diagnostics</b> show whether the bands can be trusted. Each that is out of bounds comes with a suggestion.</li>
</ul>"""
