//! The page itself: one HTML, one style sheet, a few modules, the texts; all in the binary.

/// What a browser takes it for.
const HTML: &str = "text/html; charset=utf-8";
const CSS: &str = "text/css; charset=utf-8";
const SCRIPT: &str = "text/javascript; charset=utf-8";
const TEXT: &str = "text/plain; charset=utf-8";
const JSON: &str = "application/json";
const SVG: &str = "image/svg+xml";

/// Path, type and bytes of each.
pub(super) const ASSETS: &[(&str, &str, &[u8])] = &[
    ("/", HTML, include_bytes!("page/index.html")),
    ("/style.css", CSS, include_bytes!("page/style.css")),
    ("/icon.svg", SVG, include_bytes!("page/icon.svg")),
    ("/main.js", SCRIPT, include_bytes!("page/main.js")),
    ("/common.js", SCRIPT, include_bytes!("page/common.js")),
    ("/live.js", SCRIPT, include_bytes!("page/live.js")),
    ("/overview.js", SCRIPT, include_bytes!("page/overview.js")),
    ("/parcels.js", SCRIPT, include_bytes!("page/parcels.js")),
    ("/plc.js", SCRIPT, include_bytes!("page/plc.js")),
    ("/events.js", SCRIPT, include_bytes!("page/events.js")),
    ("/trend.js", SCRIPT, include_bytes!("page/trend.js")),
    ("/setup.js", SCRIPT, include_bytes!("page/setup.js")),
    ("/site.js", SCRIPT, include_bytes!("page/site.js")),
    ("/stills.js", SCRIPT, include_bytes!("page/stills.js")),
    // As it is published: https://github.com/leeoniya/uPlot, version 1.6.32.
    ("/uplot.js", SCRIPT, include_bytes!("page/uplot/uPlot.iife.min.js")),
    ("/uplot.css", CSS, include_bytes!("page/uplot/uPlot.min.css")),
    ("/uplot.txt", TEXT, include_bytes!("page/uplot/LICENSE")),
    ("/en.json", JSON, include_bytes!("page/en.json")),
    ("/de.json", JSON, include_bytes!("page/de.json")),
];
