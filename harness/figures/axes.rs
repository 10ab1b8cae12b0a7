//! Axes, series and legends on a page.

use super::page::{BLACK, BLUE, COLUMN, GRAY, Mark, PALE, Page, Point, Stroke, Type, VERMILION};
use harness_analysis::Interval;
use harness_metrics::Direction;
use harness_spec::Scenario;

const AXIS: Stroke = Stroke::new(BLACK, 0.6);
const GRID: Stroke = Stroke::new(PALE, 0.5);
const TICK: f64 = 2.2;

/// Maps values to positions along an axis.
#[derive(Debug, Clone)]
pub struct Scale {
    low: f64,
    high: f64,
    step: f64,
    kind: Kind,
    /// Positions of the low and the high end on the page, points.
    ends: [f64; 2],
}

/// How values are mapped to positions.
#[derive(Debug, Clone, Copy)]
enum Kind {
    Linear,
    /// Logarithmic. `low` and `high` are exponents of ten.
    Logarithmic,
    /// Linear around 0 and logarithmic far from it, on both sides: the inverse hyperbolic sine of the value divided by
    /// this number.
    Symmetric(f64),
}

impl Scale {
    /// A linear axis over `[low, high]`, widened to round numbers, with about `ticks` ticks at round numbers.
    pub fn linear(low: f64, high: f64, ticks: usize, ends: [f64; 2]) -> Self {
        let span = if high > low { high - low } else { 1.0 };
        let rough = span / ticks.max(1) as f64;
        let power = 10f64.powf(rough.log10().floor());
        let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|factor| factor * power).find(|step| *step >= rough);
        let step = step.unwrap_or(10.0 * power);
        let (low, high) = ((low / step + 1e-9).floor() * step, (low.max(high) / step - 1e-9).ceil() * step);
        Self { low, high: if high > low { high } else { low + step }, step, kind: Kind::Linear, ends }
    }

    /// An axis over `[low, high]` with a small margin. It is linear for values much smaller than `linear`, and
    /// logarithmic for values much larger. It has ticks at 0 and at the powers of ten above `linear`.
    pub fn symmetric(low: f64, high: f64, linear: f64, ends: [f64; 2]) -> Self {
        let (low, high) = ((low / linear).asinh(), (high.max(low) / linear).asinh());
        let margin = if high > low { (high - low) * 0.04 } else { 0.5 };
        Self { low: low - margin, high: high + margin, step: 1.0, kind: Kind::Symmetric(linear), ends }
    }

    /// A logarithmic axis over `[low, high]`, widened to powers of ten. Both must be above 0.
    pub fn logarithmic(low: f64, high: f64, ends: [f64; 2]) -> Self {
        let (low, high) = (low.log10().floor(), high.log10().ceil());
        Self { low, high: high.max(low + 1.0), step: 1.0, kind: Kind::Logarithmic, ends }
    }

    /// A value's position on the page, points.
    pub fn at(&self, value: f64) -> f64 {
        let value = match self.kind {
            Kind::Linear => value,
            Kind::Logarithmic => value.log10(),
            Kind::Symmetric(linear) => (value / linear).asinh(),
        };
        self.ends[0] + (value - self.low) / (self.high - self.low) * (self.ends[1] - self.ends[0])
    }

    /// The value on the axis that is nearest to `value`.
    pub fn clamp(&self, value: f64) -> f64 {
        let [low, high] = self.range();
        value.clamp(low, high)
    }

    /// Whether an end of an interval lies beyond the axis.
    pub fn cuts(&self, value: &Interval) -> bool {
        [value.low(), value.high()].iter().any(|end| self.clamp(*end) != *end)
    }

    /// The values at the axis' low and high end.
    pub fn range(&self) -> [f64; 2] {
        [self.low, self.high].map(|end| match self.kind {
            Kind::Linear => end,
            Kind::Logarithmic => 10f64.powf(end),
            Kind::Symmetric(linear) => linear * end.sinh(),
        })
    }

    /// The values at the axis' ticks, with their labels.
    fn ticks(&self) -> Vec<(f64, String)> {
        if let Kind::Symmetric(linear) = self.kind {
            let [low, high] = self.range();
            let powers = (0..).map(|power| 10f64.powi(linear.log10().floor() as i32 + 1 + power));
            let powers: Vec<f64> = powers.take_while(|value| *value <= high.max(-low)).collect();
            let negative = powers.iter().rev().map(|value| -value);
            let values = negative.chain([0.0]).chain(powers.iter().copied());
            let within = values.filter(|value| (low..=high).contains(value));
            return within.map(|value| (value, format!("{value}").replace('-', "\u{2212}"))).collect();
        }
        let first = (self.low / self.step - 1e-6).ceil() as i64;
        let last = (self.high / self.step + 1e-6).floor() as i64;
        let decimals = (-self.step.log10().floor()).max(0.0) as usize;
        (first..=last)
            .map(|tick| {
                let place = tick as f64 * self.step;
                if matches!(self.kind, Kind::Logarithmic) {
                    return (10f64.powf(place), power_of_ten(place));
                }
                let text = format!("{place:.decimals$}").replace('-', "\u{2212}");
                (place, if tick == 0 { "0".into() } else { text })
            })
            .collect()
    }
}

/// A power of ten in digits from 0.001 to 1000, and as `10^{n}` beyond.
fn power_of_ten(exponent: f64) -> String {
    match exponent as i32 {
        exponent @ -3..=3 => format!("{}", 10f64.powi(exponent)),
        exponent => format!("10^{{{exponent}}}").replace('-', "\u{2212}"),
    }
}

/// The rectangle that data are drawn in, within its axes.
#[derive(Debug, Clone, Copy)]
pub struct Panel {
    /// Distance of the left edge from the page's left edge, points.
    pub left: f64,
    /// Distance of the upper edge from the page's upper edge, points.
    pub top: f64,
    /// Width, points.
    pub width: f64,
    /// Height, points.
    pub height: f64,
}

impl Panel {
    /// Distance of the right edge from the page's left edge, points.
    pub fn right(&self) -> f64 {
        self.left + self.width
    }

    /// Distance of the lower edge from the page's upper edge, points.
    pub fn bottom(&self) -> f64 {
        self.top + self.height
    }

    /// The ends of a horizontal scale: the left and the right edge, points.
    pub fn across(&self) -> [f64; 2] {
        [self.left, self.right()]
    }

    /// The ends of a vertical scale: the lower and the upper edge, points.
    pub fn upwards(&self) -> [f64; 2] {
        [self.bottom(), self.top]
    }

    /// Writes the panel's letter and title above it. A title that is wider than the panel is written smaller.
    pub fn heading(&self, page: &mut Page, letter: &str, title: &str) {
        let [left, line] = [self.left - 1.0, self.top - 4.5];
        page.text(letter, [left, line], Type::BOLD);
        let start = left + Type::BOLD.width(letter) + 3.5;
        let label = Type::LABEL.start();
        let fitting = (self.right() - start) / label.width(title);
        page.text(title, [start, line], Type { size: label.size * fitting.min(1.0), ..label });
    }

    /// Draws a vertical axis with grid lines across the panel. Without a label, the axis has no numbers.
    pub fn left_axis(&self, page: &mut Page, scale: &Scale, label: Option<&str>) {
        let mut widest: f64 = 0.0;
        for (value, text) in scale.ticks() {
            let y = scale.at(value);
            page.line([self.left, y], [self.right(), y], GRID);
            page.line([self.left - TICK, y], [self.left, y], AXIS);
            if label.is_some() {
                page.text(&text, [self.left - TICK - 1.5, y + 2.2], Type::SMALL.end());
                widest = widest.max(Type::SMALL.width(&text));
            }
        }
        page.line([self.left, self.top], [self.left, self.bottom()], AXIS);
        if let Some(label) = label {
            // Wide numbers move the label to the left, but never off the page.
            let x = (self.left - TICK - 1.5 - widest - 3.5).max(Type::LABEL.size);
            page.text(label, [x, self.top + self.height / 2.0], Type::LABEL.upright());
        }
    }

    /// Draws a horizontal axis. Without a label, the axis has no numbers.
    pub fn bottom_axis(&self, page: &mut Page, scale: &Scale, label: Option<&str>) {
        let mut free = f64::NEG_INFINITY;
        for (value, text) in scale.ticks() {
            let x = scale.at(value);
            page.line([x, self.bottom()], [x, self.bottom() + TICK], AXIS);
            // Numbers stay within the panel's width, so that they don't overlap those of the next panel. A tick has no
            // number if it would overlap the number before.
            let half = Type::SMALL.width(&text) / 2.0;
            let x = x.clamp(self.left - 1.0 + half, self.right() + 1.0 - half);
            if label.is_some() && x - half > free {
                page.text(&text, [x, self.bottom() + TICK + 6.5], Type::SMALL);
                free = x + half + 1.5;
            }
        }
        self.bottom_line(page, label);
    }

    /// Draws a horizontal axis with a name below each of `centers`, which are horizontal positions in points.
    pub fn bottom_names(&self, page: &mut Page, centers: &[f64], names: &[String], label: &str) {
        for (x, name) in centers.iter().zip(names) {
            page.line([*x, self.bottom()], [*x, self.bottom() + TICK], AXIS);
            page.text(name, [*x, self.bottom() + TICK + 6.5], Type::SMALL);
        }
        self.bottom_line(page, Some(label));
    }

    /// Draws the bottom axis with a tick at each of these positions, without words.
    pub fn bottom_ticks(&self, page: &mut Page, centers: &[f64]) {
        for x in centers {
            page.line([*x, self.bottom()], [*x, self.bottom() + TICK], AXIS);
        }
        self.bottom_line(page, None);
    }

    fn bottom_line(&self, page: &mut Page, label: Option<&str>) {
        page.line([self.left, self.bottom()], [self.right(), self.bottom()], AXIS);
        if let Some(label) = label {
            page.text(label, [self.left + self.width / 2.0, self.bottom() + TICK + 15.5], Type::LABEL);
        }
    }

    /// Horizontal positions of the middles of `count` equal parts of the panel's width, points.
    pub fn slots(&self, count: usize) -> Vec<f64> {
        let slot = self.width / count.max(1) as f64;
        (0..count).map(|index| self.left + (index as f64 + 0.5) * slot).collect()
    }
}

/// How a series looks. Colors show scenarios, and shapes show directions, so that readers don't need colors to tell
/// directions apart.
#[derive(Debug, Clone, Copy)]
pub struct Look {
    /// The color as SVG writes it, `#rrggbb`.
    pub color: &'static str,
    /// The shape of its points.
    pub mark: Mark,
    /// Whether its points are hollow.
    pub hollow: bool,
    /// The line through its points.
    pub line: Line,
}

/// The line through the points of a series.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Line {
    /// A solid line.
    Solid,
    /// A dashed line.
    Dashed,
    /// None, because what is between the points has no meaning.
    None,
}

/// The color of a scenario.
pub fn color_of(scenario: Scenario) -> &'static str {
    match scenario {
        Scenario::EMPTY => BLUE,
        _ => VERMILION,
    }
}

/// The look of a direction in this color: hollow squares and a dashed line for adduction/abduction, filled discs and a
/// solid line otherwise.
pub fn look_of(color: &'static str, direction: Direction) -> Look {
    let lateral = direction == Direction::ADDUCTION_ABDUCTION;
    let mark = if lateral { Mark::Square } else { Mark::Disc };
    let line = if lateral { Line::Dashed } else { Line::Solid };
    Look { color, mark, hollow: lateral, line }
}

/// A direction's name for people.
pub fn words_of(direction: Direction) -> &'static str {
    match direction {
        Direction::FLEXION_EXTENSION => "flexion/extension",
        _ => "adduction/abduction",
    }
}

impl Look {
    /// Draws a value's mean as a point at `x`, with its interval as a bar, if it has one.
    pub fn point(&self, page: &mut Page, x: f64, scale: &Scale, value: &Interval) {
        if let Some((low, high)) = value.bounds {
            let stroke = Stroke::new(self.color, 0.8);
            page.line([x, scale.at(scale.clamp(low))], [x, scale.at(scale.clamp(high))], stroke);
            // An end beyond the axis has no cap.
            for end in [low, high].into_iter().filter(|end| scale.clamp(*end) == *end) {
                page.line([x - 1.5, scale.at(end)], [x + 1.5, scale.at(end)], stroke);
            }
        }
        page.mark(self.mark, [x, scale.at(scale.clamp(value.mean))], 2.0, self.color, self.hollow);
    }

    /// Draws the series' line through the points, if it has one and there are at least two points.
    pub fn path(&self, page: &mut Page, points: &[Point]) {
        let stroke = Stroke::new(self.color, 0.9);
        match self.line {
            Line::Solid if points.len() > 1 => page.path(points, stroke),
            Line::Dashed if points.len() > 1 => page.path(points, stroke.dashed()),
            _ => {}
        }
    }
}

/// Draws a legend of looks in one row. Its middle is at `middle`, and its base line at `y`, in points.
pub fn legend(page: &mut Page, middle: f64, y: f64, entries: &[(Look, &str)]) {
    const KEY: f64 = 14.0;
    const GAP: f64 = 3.0;
    const BETWEEN: f64 = 10.0;
    let how = Type::SMALL.start();
    let widths: Vec<f64> = entries.iter().map(|(_, words)| KEY + GAP + how.width(words)).collect();
    let mut x = middle - (widths.iter().sum::<f64>() + BETWEEN * (entries.len() as f64 - 1.0)) / 2.0;
    for ((look, words), width) in entries.iter().zip(widths) {
        look.path(page, &[[x, y - 2.2], [x + KEY, y - 2.2]]);
        page.mark(look.mark, [x + KEY / 2.0, y - 2.2], 2.0, look.color, look.hollow);
        page.text(words, [x + KEY + GAP, y], how);
        x += width + BETWEEN;
    }
}

/// Draws a legend of colors in one row. Its middle is at `middle`, and its base line at `y`, in points.
pub fn color_legend(page: &mut Page, middle: f64, y: f64, entries: &[(&'static str, &str)]) {
    let how = Type::SMALL.start();
    let widths: Vec<f64> = entries.iter().map(|(_, words)| 10.0 + how.width(words)).collect();
    let mut x = middle - (widths.iter().sum::<f64>() + 10.0 * (entries.len() as f64 - 1.0)) / 2.0;
    for ((color, words), width) in entries.iter().zip(widths) {
        page.rectangle([x, y - 5.2], [6.0, 6.0], 1.0, color, None);
        page.text(words, [x + 9.0, y], how);
        x += width + 10.0;
    }
}

/// The height of a line of remarks, points.
const REMARK: f64 = 8.5;

/// Writes remarks below the panels of a page as wide as a column, from `y` on. The page has room for a line for each, and
/// grows by those that are too long for one.
pub fn remarks(page: &mut Page, y: f64, remarks: impl IntoIterator<Item = impl AsRef<str>>) {
    let remarks: Vec<Vec<String>> = remarks.into_iter().map(|text| lines_of(text.as_ref(), COLUMN)).collect();
    let lines = remarks.concat();
    page.grow(REMARK * (lines.len() - remarks.len()) as f64);
    for (row, line) in lines.iter().enumerate() {
        remark(page, line, [COLUMN / 2.0, y + REMARK * row as f64]);
    }
}

/// Makes the page higher by a remark, and writes it there.
pub fn remark_below(page: &mut Page, text: &str) {
    for line in lines_of(text, page.width()) {
        let bottom = page.grow(REMARK);
        remark(page, &line, [page.width() / 2.0, bottom + 4.0]);
    }
}

/// Divides a remark into lines that fit a page of this width in points. A word that does not fit has its own line.
fn lines_of(text: &str, width: f64) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for word in text.split(' ') {
        match lines.last_mut() {
            Some(line) if Type::SMALL.width(&format!("{line} {word}")) <= width - 6.0 => {
                line.push(' ');
                line.push_str(word);
            }
            _ => lines.push(word.to_owned()),
        }
    }
    lines
}

/// A mean with two decimals and, if it has an interval, half of the interval's width: `0.91 ± 0.02`.
pub fn mean_words(value: &Interval) -> String {
    let spread = value.bounds.map_or(String::new(), |(low, high)| format!(" ± {:.2}", (high - low) / 2.0));
    format!("{:.2}{spread}", value.mean).replace('-', "\u{2212}")
}

/// Writes a remark in small gray letters, centered at the point.
pub fn remark(page: &mut Page, text: &str, at: Point) {
    page.text(text, at, Type::SMALL.color(GRAY));
}
