//! What the pages of `harness report` and `harness serve` share: the charts, which uPlot draws, and their colors.
//!
//! uPlot is bundled, so the pages need no network. Its license is in the script, because a report is passed on.

/// The script: uPlot, `element` and other small functions, what charts have in common, and the class `Chart`.
pub const SCRIPT: &str = concat!(
    "\"use strict\";\n/*!\nuPlot\n\n",
    include_str!("uPlot.LICENSE"),
    "\n*/\n",
    include_str!("uPlot.iife.min.js"),
    include_str!("elements.js"),
    include_str!("contents.js"),
    include_str!("chart.js"),
);

/// The style sheet: the colors of both themes, and the charts.
pub const STYLE: &str = concat!(include_str!("uPlot.min.css"), "\n", include_str!("chart.css"));
