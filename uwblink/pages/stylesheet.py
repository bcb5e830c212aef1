"""The look of pages, on a screen, on a phone, by day and by night, and on paper."""

from __future__ import annotations

from typing import Final

from uwblink.pages.colours import GROUND
from uwblink.pages.drawings import colours_css

_LIGHT: Final = (
    f"--ink: #1a1a1a; --page: {GROUND['light']}; --quiet: #505459; --line: #cfd3d8; --soft: #f3f5f7; --link: #00558a; "
    "--good: #e5f4ec; --good-edge: #128a63; --doubt: #fff4e0; --doubt-edge: #b36b00; --bad: #fdeaea; --bad-edge: #a11; "
    + colours_css(False)
)
_DARK: Final = (
    f"--ink: #e8e8e8; --page: {GROUND['dark']}; --quiet: #aab0b7; --line: #41464d; --soft: #22262b; --link: #7cc0f0; "
    "--good: #17301f; --good-edge: #2fbf8f; --doubt: #33280f; --doubt-edge: #e0a030; --bad: #3a1a1c; "
    "--bad-edge: #f07070; " + colours_css(True)
)

CSS: Final = f"""
:root {{ color-scheme: light dark; {_LIGHT} }}
@media (prefers-color-scheme: dark) {{ :root {{ {_DARK} }} }}
* {{ box-sizing: border-box; }}
html {{ scroll-behavior: smooth; }}
body {{ font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--page); max-width: 1080px;
  margin: 0 auto; padding: 1rem; overflow-wrap: break-word; }}
a {{ color: var(--link); }}
h1 {{ line-height: 1.2; margin: .5rem 0; }} h2 {{ margin-top: 2.4rem; border-bottom: 1px solid var(--line); }}
p {{ max-width: 46rem; }}
.lead, .good, .doubt, .bad, .warning {{ max-width: none; padding: .6rem 1rem; border-radius: .3rem;
  border-left: .35rem solid var(--line); background: var(--soft); }}
.good {{ background: var(--good); border-color: var(--good-edge); }}
.doubt, .warning {{ background: var(--doubt); border-color: var(--doubt-edge); }}
.bad {{ background: var(--bad); border-color: var(--bad-edge); }}
.verdict {{ font-size: 1.2rem; }} .verdict b {{ font-size: 1.4rem; }}
.note, figcaption {{ font-size: .9rem; color: var(--quiet); }} .note {{ max-width: 52rem; }}
nav {{ font-size: .95rem; }} nav ol {{ columns: 18rem; padding-left: 1.4rem; }}
.wide {{ overflow-x: auto; margin: 1rem 0; }}
table {{ border-collapse: collapse; font-variant-numeric: tabular-nums; }}
th, td {{ padding: .2rem .6rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }}
th:first-child, td:first-child {{ text-align: left; position: sticky; left: 0; background: var(--page); }}
.words th, .words td {{ text-align: left; white-space: normal; vertical-align: top; }}
.words td:nth-child(2) {{ min-width: 4.6rem; }}
tr.all {{ font-weight: bold; }}
table.many {{ font-size: .85rem; }} .many th, .many td {{ padding: .2rem .38rem; }}
tr.above th {{ text-align: center; border-left: 1px solid var(--line); }}
figure {{ margin: 1.2rem 0; }}
figure svg, figure img {{ width: 100%; height: auto; display: block; overflow: visible; }}
figure .narrow {{ display: none; }} figure .wide {{ cursor: zoom-in; overflow: visible; margin: 0; }}
.series {{ transition: opacity .1s; }} svg.one .series:not(.here) {{ opacity: .18; }}
pre {{ background: var(--soft); padding: .6rem; white-space: pre-wrap; overflow-wrap: anywhere; font-size: .8rem; }}
code {{ overflow-wrap: anywhere; }}
#tip {{ position: fixed; pointer-events: none; background: var(--ink); color: var(--page); font-size: .8rem;
  padding: .15rem .5rem; border-radius: .25rem; display: none; z-index: 9; max-width: 20rem; }}
dialog {{ width: 96vw; height: 94vh; max-width: none; max-height: none; border: 1px solid var(--line); padding: 0;
  background: var(--page); color: var(--ink); overflow: hidden; }}
dialog svg {{ width: 100%; height: calc(100% - 2.4rem); cursor: grab; }}
dialog form {{ height: 2.4rem; padding: .3rem .6rem; font-size: .9rem; }}
dialog button {{ font: inherit; color: inherit; background: var(--soft); border: 1px solid var(--line); }}
@media (max-width: 640px) {{ body {{ padding: .75rem; }} h1 {{ font-size: 1.5rem; }} h2 {{ font-size: 1.2rem; }}
  figure .wide {{ display: none; }} figure .narrow {{ display: block; }} table {{ font-size: .85rem; }}
  th, td {{ padding: .2rem .4rem; }} .verdict {{ font-size: 1.05rem; }}
  .words thead {{ display: none; }}
  .words tr {{ display: block; border-bottom: 1px solid var(--line); padding: .3rem 0; }}
  .words td {{ display: block; border: 0; padding: 0; position: static; }}
  .words td:first-child {{ font-weight: 600; }} }}
@page {{ size: A4; margin: 14mm; @bottom-center {{ content: counter(page); }} }}
@media print {{ :root {{ {_LIGHT} }} body {{ max-width: none; padding: 0; font-size: 10pt; }}
  h2 {{ break-after: avoid; }} figure, tr {{ break-inside: avoid; }} .wide {{ overflow: visible; }}
  table {{ font-size: 8.5pt; }} table.many {{ font-size: 8pt; }} th, td {{ padding: .1rem .3rem; }}
  .note, figcaption {{ font-size: 8.5pt; }} #tip, dialog {{ display: none; }} }}
"""
