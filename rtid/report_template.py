"""The frame of the report page: style sheet and order; a string.Template."""

from string import Template

PAGE = Template("""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>$title</title>
$head
<style>
:root { color-scheme: light dark; --ink: #22272b; --quiet: #5c656c; --line: #d9dde0; --paper: #fff;
  --card: #f5f7f8; --good: #00805c; --found: #b84f00; --open: #7a5b00;
  --bar: #0072b2; --before: #d55e00; }
@media screen and (prefers-color-scheme: dark) {
  :root { --ink: #e3e6e8; --quiet: #a3abb1; --line: #3a4146; --paper: #14181b; --card: #1d2327;
    --good: #4fc79f; --found: #f5995b; --open: #e3bd55; --bar: #56b4e9; --before: #f5995b; }
}
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", Helvetica, Arial, sans-serif; }
main { max-width: 1080px; margin: 0 auto; padding: 28px 24px 64px; }
.eyebrow { color: var(--quiet); font-size: 14px; margin: 0; }
h1 { font-size: 30px; line-height: 1.2; margin: 4px 0 14px; }
h1.good { color: var(--good); } h1.found { color: var(--found); } h1.open { color: var(--open); }
.verdict p { max-width: 76ch; margin: 6px 0; font-size: 17px; }
.figures { display: grid; grid-template-columns: repeat(4, 1fr); gap: 12px; margin: 22px 0 8px; }
.figures div { background: var(--card); border: 1px solid var(--line); border-radius: 8px;
  padding: 12px 14px; }
.figures b { display: block; font-size: 20px; white-space: nowrap; }
.figures span { color: var(--quiet); font-size: 13px; }
section { margin-top: 36px; border-top: 1px solid var(--line); padding-top: 6px; }
h2 { font-size: 20px; margin: 12px 0 10px; } h3 { font-size: 16px; margin: 22px 0 8px; }
figure { margin: 0; } td.n { white-space: nowrap; text-align: right; }
figcaption { color: var(--quiet); font-size: 14px; max-width: 90ch; margin: 8px 0 14px; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 14px;
  font-variant-numeric: tabular-nums; }
th { text-align: left; color: var(--quiet); font-weight: 600;
  border-bottom: 2px solid var(--line); }
th, td { padding: 5px 14px 5px 0; vertical-align: top; }
td:first-child { min-width: 15ch; } td:last-child { overflow-wrap: anywhere; }
td { border-bottom: 1px solid var(--line); }
@media (max-width: 760px) { .figures { grid-template-columns: repeat(2, 1fr); } }
@media print {
  body { font-size: 11pt; } main { max-width: none; padding: 0; }
  figure, tr, .figures div { break-inside: avoid; } h2, h3 { break-after: avoid; }
  .wide { overflow: visible; }
}
</style>
</head>
<body>
<main>
<noscript><p>The plots over time and over signals need JavaScript, which this file brings along.</p>
</noscript>
<p class="eyebrow">$title</p>
<h1 class="$kind">$headline</h1>
<div class="verdict">$sentences</div>
<div class="figures">$figures</div>
$sections
</main>
</body>
</html>
""")
