"""Building blocks of pages for people: no network, pictures inside."""

import base64
import json
from collections.abc import Iterable, Sequence
from html import escape

STYLE = """
:root{--ink:#1b2733;--soft:#5b6b7a;--line:#dfe5ea;--good:#2e7d32;--fair:#b26a00;--bad:#c62828;--back:#f6f8fa}
*{box-sizing:border-box}body{margin:0;background:var(--back);color:var(--ink);
font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif}
main{max-width:1080px;margin:0 auto;padding:28px 20px 60px}
h1{font-size:25px;margin:0 0 4px}h2{font-size:19px;margin:36px 0 10px}h3{font-size:15px;margin:22px 0 6px}
p{margin:6px 0}.soft{color:var(--soft)}code{font:12.5px ui-monospace,Menlo,Consolas,monospace}
section{background:#fff;border:1px solid var(--line);border-radius:10px;padding:16px 20px;margin:14px 0}
.cards{display:flex;flex-wrap:wrap;gap:12px;margin:18px 0}
.card{background:#fff;border:1px solid var(--line);border-radius:10px;padding:10px 18px;min-width:130px}
.card b{display:block;font-size:25px;line-height:1.25}.card span{color:var(--soft);font-size:13px}
table{border-collapse:collapse;width:100%;font-size:13px}
th{text-align:left;color:var(--soft);font-weight:600;border-bottom:1px solid var(--line);padding:5px 8px}
td{border-bottom:1px solid #eef1f4;padding:4px 8px;vertical-align:top}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums;white-space:nowrap}
td.name{overflow-wrap:anywhere;min-width:130px}
.pill{border-radius:9px;padding:1px 9px;font-size:12px;white-space:nowrap;color:#fff}
.good{background:var(--good)}.fair{background:var(--fair)}.bad{background:var(--bad)}.none{background:#78879a}
.wide{overflow-x:auto}img{max-width:100%;height:auto;display:block;margin:10px auto}
.bars td:nth-child(3){width:55%}.bar{background:#3f7fbf;height:11px;border-radius:3px;min-width:1px}
.note{border-left:4px solid var(--fair);background:#fff8ec;padding:8px 14px;
margin:10px 0;border-radius:0 6px 6px 0}
.stop{border-left-color:var(--bad);background:#fdf0ef}
details{margin:10px 0}summary{cursor:pointer;color:var(--soft)}
pre{font-size:12px;white-space:pre-wrap;overflow-wrap:anywhere}
"""


def page(title: str, parts: Iterable[str], style: str = "", script: str = "") -> str:
    """A whole page of parts that are HTML already; with style and script of its own where it has some."""
    scripts = f"<script>{script}</script>" if script else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{escape(title)}</title><style>{STYLE}{style}</style></head><body><main>"
        + "\n".join(parts)
        + f"</main>{scripts}</body></html>\n"
    )


def folded(title: str, value: object) -> str:
    """JSON behind a title that opens; nothing for an empty value."""
    if not value:
        return ""
    text = json.dumps(value, indent=1, sort_keys=True, default=str)
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[str]],
    numbers: Sequence[int] = (),
    names: Sequence[int] = (),
    html: Sequence[int] = (),
) -> str:
    """A table; columns in `numbers` to the right, in `names` broken anywhere, all but `html` escaped."""

    def kind(i: int) -> str:
        return "n" if i in numbers else "name" if i in names else ""

    def cell(i: int, text: str) -> str:
        return f'<td class="{kind(i)}">{text if i in html else escape(text)}</td>'

    header = "".join(f'<th class="{kind(i)}">{escape(h)}</th>' for i, h in enumerate(head))
    body = "".join(f"<tr>{''.join(cell(i, text) for i, text in enumerate(row))}</tr>" for row in rows)
    return f"<table>{f'<thead><tr>{header}</tr></thead>' if head else ''}<tbody>{body}</tbody></table>"


def picture(image: bytes, words: str, form: str = "png", kind: str = "") -> str:
    """A PNG or JPEG inside the page, of a class of the page's style."""
    data = base64.b64encode(image).decode("ascii")
    return f'<img class="{kind}" alt="{escape(words)}" src="data:image/{form};base64,{data}">'


def note(text: str) -> str:
    """A sentence that catches the eye."""
    return f'<p class="note">{escape(text)}</p>'


def pill(kind: str, text: str) -> str:
    """A small coloured label: good, fair, bad or none."""
    return f'<span class="pill {kind}">{escape(text)}</span>'


def number(value: float | None, form: str) -> str:
    """Formatted, or nothing for None."""
    return "" if value is None else form.format(value)


def duration(seconds: float) -> str:
    """Seconds, minutes beyond two of them."""
    return f"{seconds:.1f} s" if seconds < 120 else f"{seconds / 60:.1f} min"
