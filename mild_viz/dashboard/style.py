"""The page's style sheet: the timeline docked below the scene, and the look of the charts.

viser docks panels to the left and right edges only. The timeline therefore is a floating panel that the rules
below pin to the bottom, as wide as the scene, with the scene shortened by as much. Where a browser lacks CSS
anchor positioning, the panel simply floats at the bottom. `tests/test_dashboard_page.py` checks the geometry,
since the selectors follow viser's markup.
"""

from __future__ import annotations

PANEL_WIDTH = 344
"""Width of the control panel [px]."""
FLOATING_SIZE = (900, 300)
"""Size of the timeline where it cannot be docked [px]."""
GUTTER = (124, 64)
"""Space left and right of every chart for its name and its range [px]."""

TIMELINE_CSS = """
@supports (anchor-name: --a) {
  [data-dock-region="right"] { anchor-name: --mv-right; }
  [data-dock-root]:has(.mv-timeline) { --mv-height: clamp(314px, 40vh, 434px); }
  [data-dock-root]:has(.mv-timeline) > :first-child { bottom: var(--mv-height) !important; }
  [data-floating-window]:has(.mv-timeline) {
    left: 0 !important; top: auto !important; bottom: 0 !important; width: auto !important;
    right: anchor(--mv-right left, 0px) !important; height: var(--mv-height) !important;
    border-radius: 0 !important; z-index: 4 !important;
    border-top: 1px solid var(--mantine-color-default-border);
  }
  [data-floating-window]:has(.mv-timeline) [data-dock-strip] { display: none !important; }
  [data-floating-window]:has(.mv-timeline) [data-dock-resize] { display: none; }
}
[data-floating-window]:has(.mv-timeline) .mantine-ScrollArea-content,
[data-floating-window]:has(.mv-timeline) .mantine-ScrollArea-content > div,
[data-floating-window]:has(.mv-timeline) .mantine-ScrollArea-content > div > div { height: 100%; }
.mv-timeline { display: none; }
div:has(> div > .mv-timeline) {
  display: grid; grid-template-columns: auto auto auto minmax(0, 1fr); align-items: center; height: 100%;
  grid-template-rows: 28px 22px auto auto minmax(26px, 4fr) minmax(60px, 18fr) minmax(28px, 4fr)
    var(--mv-force-row,) 14px;
  padding: 2px 0 0 0 !important; box-sizing: border-box;
}
div:has(> div > .mv-timeline) > div { padding-bottom: 0 !important; }
div:has(> div > .mv-timeline) > div:has(> .mv-lane) { grid-column: 1 / -1; height: 100%; min-height: 0; }
div:has(> div > .mv-timeline) > div:has(> style) { display: none; }
div:has(> div > .mv-timeline) > div:nth-child(2) { padding-inline: LEFTpx 4px !important; }
div:has(> div > .mv-timeline) > div:nth-child(2) > div > div:first-child { display: none; }
div:has(> div > .mv-timeline) > div:nth-child(2) button:nth-child(3) {
  background: var(--mantine-primary-color-filled); color: #fff; min-width: 56px;
}
div:has(> div > .mv-timeline) > div:nth-child(3) > div > div:first-child,
div:has(> div > .mv-timeline) > div:nth-child(4) > div > div:first-child {
  width: auto !important;
}
div:has(> div > .mv-timeline) > div:nth-child(3) > div > div:last-child { width: 76px; }
div:has(> div > .mv-timeline) > div:nth-child(6) { grid-column: 1 / -1; padding-inline: 0 !important; }
div:has(> div > .mv-timeline) > div:nth-child(6) > div > div:first-child {
  width: LEFTpx !important; text-align: right; box-sizing: border-box; padding-right: 8px;
}
div:has(> div > .mv-timeline) > div:nth-child(6) .mantine-InputWrapper-root {
  width: 46px !important; margin-inline: 14px 4px !important;
}
div:has(> div > .mv-timeline) > div:nth-child(6) .mantine-Slider-root { margin-inline: -3.7px; }
div:has(> div > .mv-timeline) > div:nth-child(4) input { display: block; }
.mv-lane { height: 100%; }
[data-dock-root]:has(.mv-force) { --mv-height: clamp(338px, 44vh, 450px) !important; }
div:has(> div > .mv-timeline):has(.mv-force) { --mv-force-row: minmax(28px, 5fr); }
div:has(> div > .mv-timeline) > div:has(> .mv-force) { order: 1; }
div:has(> div > .mv-timeline) > div:has(> .mv-axis) { order: 2; }
"""
TIMELINE_CSS = TIMELINE_CSS.replace("LEFT", str(GUTTER[0]))

CHART_CSS = """
.mv-now {
  font-size: 12px; line-height: 14px; overflow: hidden; text-align: right; padding-right: 10px;
  color: var(--mantine-color-text); font-variant-numeric: tabular-nums;
}
.mv-now > span { white-space: nowrap; margin-left: 12px; }
.mv-lane {
  display: flex; font-size: 11px; line-height: 1.1; color: var(--mantine-color-text); position: relative;
  font-variant-numeric: tabular-nums;
}
.mv-name { width: LEFTpx; flex: none; box-sizing: border-box; padding: 0 8px 0 10px; text-align: right;
  align-self: center; overflow: hidden; text-overflow: ellipsis; white-space: nowrap; }
.mv-name small, .mv-range { color: var(--mantine-color-dimmed); font-size: 10px; }
.mv-name small { display: block; }
.mv-range { width: RIGHTpx; flex: none; box-sizing: border-box; padding: 0 4px; display: flex; flex-direction: column;
  justify-content: space-between; }
.mv-plot { flex: 1; position: relative; min-width: 0; border-bottom: 1px solid var(--mantine-color-default-border); }
.mv-plot svg { position: absolute; inset: 0; width: 100%; height: 100%; display: block; overflow: hidden; }
.mv-plot polyline { fill: none; stroke-width: 1.6; vector-effect: non-scaling-stroke; stroke-linejoin: round; }
.mv-grid line { stroke: var(--mantine-color-default-border); stroke-width: 1; vector-effect: non-scaling-stroke; }
.mv-plot .mv-lost { fill: var(--mantine-color-dimmed); opacity: 0.35; }
.mv-plot .mv-touch { fill: var(--mantine-color-text); opacity: 0.08; }
.mv-commanded { stroke: var(--mantine-color-text); }
.mv-stiffness { stroke: var(--mantine-color-dimmed); stroke-dasharray: 2 3; }
.mv-full { stroke: #e8590c; stroke-dasharray: 5 3; }
.mv-decoded { stroke: #1c7ed6; stroke-dasharray: 5 3; }
.mv-truth { stroke: #f08c00; stroke-width: 3 !important; opacity: 0.55; }
.mv-cursor {
  position: absolute; top: 0; bottom: -1px; width: 2px; margin-left: -1px; background: var(--mantine-color-red-6);
  left: calc(var(--mv-time, 0) * 1%); pointer-events: none;
}
.mv-segment { position: absolute; top: 0; bottom: 0; display: flex; align-items: center; justify-content: center;
  font-size: 10px; font-weight: 600; overflow: hidden; }
.mv-states { height: 17px; }
.mv-states.mv-with-phase { height: 29px; }
.mv-fired { height: 26px; }
.mv-fired .mv-name { align-self: flex-start; padding-top: 1px; }
.mv-fired .mv-name small { margin-top: 2px; line-height: 11px; }
.mv-fired .mv-plot { border-bottom: none; }
.mv-fired .mv-strip { height: 12px; }
.mv-safety { position: absolute; left: 0; right: 0; top: 13px; height: 12px; }
.mv-fired .mv-segment { font-weight: 400; font-size: 9px; white-space: nowrap; box-sizing: border-box;
  border-right: 1px solid var(--mantine-color-body); }
.mv-lane .mv-plot, .mv-rows { cursor: pointer; }
.mv-states .mv-name small { margin-top: 4px; line-height: 11px; }
.mv-states .mv-name { align-self: flex-start; padding-top: 1px; }
.mv-states .mv-plot { border-bottom: none; }
.mv-strip { position: absolute; left: 0; right: 0; top: 0; height: 13px; }
.mv-contact { position: absolute; left: 0; right: 0; top: 13px; height: 3px; }
.mv-phase { position: absolute; left: 0; right: 0; top: 17px; height: 11px; }
.mv-phase .mv-segment { font-weight: 400; font-size: 9px; }
.mv-joints { display: flex; flex-direction: column; }
.mv-head {
  display: flex; align-items: center; height: 14px; flex: none; color: var(--mantine-color-dimmed); font-size: 10px;
}
.mv-head .mv-name { font-size: 11px; color: var(--mantine-color-text); }
.mv-rows { flex: 1; min-height: 0; }
.mv-row { display: flex; }
.mv-row .mv-name { font-size: 10px; }
.mv-one { justify-content: center; letter-spacing: -0.3px; white-space: nowrap; }
.mv-over { position: absolute; top: 0; bottom: 0; left: LEFTpx; right: RIGHTpx; pointer-events: none; }
.mv-axis .mv-plot { border: none; }
.mv-axis span {
  position: absolute; transform: translateX(-50%); color: var(--mantine-color-dimmed); font-size: 10px; top: 1px;
}
.mv-key { display: inline-flex; align-items: center; gap: 4px; margin-right: 12px; }
.mv-key svg { position: static; width: 22px; height: 8px; }
.mv-patch { width: 22px; height: 9px; background: color-mix(in srgb, var(--mantine-color-text) 12%, transparent);
  border-top: 3px solid var(--mantine-color-text); box-sizing: border-box; }
.mv-patch.mv-gap { background: color-mix(in srgb, var(--mantine-color-dimmed) 35%, transparent); border: none; }
.mv-key line { stroke-width: 2; }
""".replace("LEFT", str(GUTTER[0])).replace("RIGHT", str(GUTTER[1]))

PANEL_CSS = """
.mv-swatch {
  display: inline-block; width: 0.75em; height: 0.75em; border-radius: 2px; margin-right: 0.35em;
  vertical-align: -0.05em;
}
.mv-header { padding: 0 12px 6px; font-size: 13px; line-height: 1.45; color: var(--mantine-color-text);
  font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.mv-live { padding-bottom: 14px; }
.mv-note {
  padding: 2px 12px 8px; font-size: 12px; line-height: 1.4; color: var(--mantine-color-dimmed); overflow-wrap: anywhere;
}
.mv-table { margin: 0 12px 6px; width: calc(100% - 24px); border-collapse: collapse; font-size: 12px; line-height: 1.3;
  font-variant-numeric: tabular-nums; color: var(--mantine-color-text); }
.mv-table th { font-weight: 500; text-align: right; vertical-align: bottom; padding: 2px 0 2px 6px; }
.mv-table tr > th:first-child { text-align: left; white-space: nowrap; padding-left: 0; }
.mv-table td { text-align: right; padding: 2px 0 2px 6px; border-top: 1px solid var(--mantine-color-default-border); }
.mv-table td:first-child { text-align: left; padding-left: 0; }
.mv-table tr + tr th { border-top: 1px solid var(--mantine-color-default-border); }
.mv-note b { color: var(--mantine-color-text); }
.mv-note code { font-size: 11px; }
.mv-error { margin: 0 12px 14px; padding: 8px 10px; font-size: 12px; line-height: 1.4; border-radius: 4px;
  color: #c92a2a; background: #fff5f5; border: 1px solid #ffa8a8; overflow-wrap: anywhere; }
[data-mantine-color-scheme="dark"] .mv-error { color: #ffc9c9; background: #4a1d1d; border-color: #a03030; }
"""
