//! A page with shapes, text and pictures. Lengths are in points. A page is saved as SVG, or as a PNG or PDF of that SVG.
//!
//! The project has no plotting library, because one would help with only four of the paper's nine figures. Pictures
//! with labels, grids of frames and diagrams of networks need a page like this one. Axes are in the module `axes`.

use super::FigureError;
use super::text::{self, EM, Face, Line};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use image::{DynamicImage, ImageFormat, RgbImage};
use resvg::{tiny_skia, usvg};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::io::Cursor;

/// Width of a journal's column, 8.5 cm, in points.
pub const COLUMN: f64 = 241.0;
/// Pixels per point in the PNG, which has 600 pixels per inch.
const PNG_SCALE: f32 = 600.0 / 72.0;

/// Color of text, axes and outlines.
pub(crate) const BLACK: &str = "#1a1a1a";
/// Color of remarks and thin outlines.
pub(crate) const GRAY: &str = "#767676";
/// Color of grid lines and shaded rows.
pub(crate) const PALE: &str = "#e4e4e4";
/// Color of the page.
pub(crate) const WHITE: &str = "#ffffff";
/// Blue of Okabe and Ito's palette, whose colors color-blind people can tell apart.
pub(crate) const BLUE: &str = "#0072b2";
/// Vermilion of Okabe and Ito's palette.
pub(crate) const VERMILION: &str = "#d55e00";
/// Green of Okabe and Ito's palette.
pub(crate) const GREEN: &str = "#009e73";
/// Wine of Tol's palette, used together with [`GREEN`].
pub(crate) const WINE: &str = "#882255";

/// A position `[x, y]` in points from the page's upper left corner. `y` grows downwards.
pub type Point = [f64; 2];

/// How a line is drawn.
#[derive(Debug, Clone, Copy)]
pub struct Stroke {
    /// The color as SVG writes it, `#rrggbb`.
    pub color: &'static str,
    /// The line's width, points.
    pub width: f64,
    /// Whether the line is dashed. Dashes scale with the width.
    pub dashed: bool,
}

impl Stroke {
    /// A solid line of this color and width in points.
    pub const fn new(color: &'static str, width: f64) -> Self {
        Self { color, width, dashed: false }
    }

    /// The same line, dashed.
    pub(crate) const fn dashed(self) -> Self {
        Self { dashed: true, ..self }
    }

    fn attributes(&self) -> String {
        let dash = if self.dashed {
            format!(" stroke-dasharray=\"{} {}\"", number(self.width * 2.6), number(self.width * 1.8))
        } else {
            String::new()
        };
        format!("fill=\"none\" stroke=\"{}\" stroke-width=\"{}\"{dash}", self.color, number(self.width))
    }
}

/// Which part of a line of text lies at its point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Anchor {
    /// The line's beginning.
    Start,
    /// The line's middle.
    Middle,
    /// The line's end.
    End,
}

/// How a text is set.
#[derive(Debug, Clone, Copy)]
pub struct Type {
    /// The font's size, points.
    pub size: f64,
    /// The font's style. Markup in the text can change it.
    pub face: Face,
    /// The color as SVG writes it, `#rrggbb`.
    pub color: &'static str,
    /// Which part of the text lies at its point.
    pub anchor: Anchor,
    /// Whether the text is turned by 90 degrees and reads upwards.
    pub upright: bool,
}

impl Type {
    /// Labels of axes.
    pub const LABEL: Type =
        Type { size: 7.0, face: Face::Regular, color: BLACK, anchor: Anchor::Middle, upright: false };
    /// Numbers at ticks, and notes.
    pub(crate) const SMALL: Type = Type { size: 6.2, ..Self::LABEL };
    /// Headings.
    pub(crate) const BOLD: Type = Type { size: 7.5, face: Face::Bold, anchor: Anchor::Start, ..Self::LABEL };

    /// The same type, with the text's beginning at the point.
    pub const fn start(self) -> Self {
        Self { anchor: Anchor::Start, ..self }
    }

    /// The same type, with the text's end at the point.
    pub const fn end(self) -> Self {
        Self { anchor: Anchor::End, ..self }
    }

    /// The same type, with the text's middle at the point.
    pub const fn middle(self) -> Self {
        Self { anchor: Anchor::Middle, ..self }
    }

    /// The same type in this color.
    pub const fn color(self, color: &'static str) -> Self {
        Self { color, ..self }
    }

    /// The same type, reading upwards.
    pub(crate) const fn upright(self) -> Self {
        Self { upright: true, ..self }
    }

    /// The width of a line of text, points.
    pub fn width(&self, text: &str) -> f64 {
        text::line(text, self.face, self.size).width
    }
}

/// The shape of a data point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    /// A circle.
    Disc,
    /// An upright square.
    Square,
    /// A square on one of its corners.
    Diamond,
    /// A triangle that points upwards.
    Triangle,
    /// Two crossed lines, which look the same hollow.
    Cross,
}

/// A page that shapes, text and pictures are drawn on.
pub struct Page {
    width: f64,
    height: f64,
    title: String,
    parts: Vec<Part>,
}

/// A part of a page. Later parts lie above earlier ones.
pub(super) enum Part {
    /// SVG elements without text.
    Shapes(String),
    /// A line of text.
    Text(Text),
}

/// A line of text on a page.
pub(super) struct Text {
    /// The letters.
    pub line: Line,
    /// Where the line's anchor is.
    pub at: Point,
    /// How it is set.
    pub how: Type,
}

impl Text {
    /// The position and rotation of the line's own coordinates as SVG writes them. The anchor is at their origin.
    fn placement(&self) -> String {
        let [x, y] = self.at.map(number);
        format!("translate({x} {y}){}", if self.how.upright { " rotate(-90)" } else { "" })
    }

    /// Where the line begins, in points along it from its anchor.
    pub fn start(&self) -> f64 {
        match self.how.anchor {
            Anchor::Start => 0.0,
            Anchor::Middle => -self.line.width / 2.0,
            Anchor::End => -self.line.width,
        }
    }

    /// The line as SVG, with the outlines of `glyphs` that are defined elsewhere in the document.
    fn svg(&self) -> String {
        let mut svg = format!(
            "<g role=\"img\" aria-label=\"{}\" fill=\"{}\" transform=\"{}\">",
            escaped(&self.line.plain),
            self.how.color,
            self.placement()
        );
        for glyph in &self.line.glyphs {
            if text::outline(glyph.face, glyph.id).is_empty() {
                continue;
            }
            let scale = glyph.size / EM;
            // Writing to a string can't fail.
            let _ = write!(
                svg,
                "<use href=\"#{}\" transform=\"matrix({scale:.5} 0 0 {:.5} {} {})\"/>",
                glyph_name(glyph.face, glyph.id),
                -scale,
                number(self.start() + glyph.x),
                number(-glyph.rise),
            );
        }
        svg.push_str("</g>\n");
        svg
    }
}

impl Page {
    /// An empty page of this width and height in points. The title describes the page to screen readers.
    pub fn new(width: f64, height: f64, title: &str) -> Self {
        Self { width, height, title: title.to_owned(), parts: Vec::new() }
    }

    /// The width of the page, points.
    pub fn width(&self) -> f64 {
        self.width
    }

    /// Makes the page higher by this many points, and returns the height that it had.
    pub(crate) fn grow(&mut self, points: f64) -> f64 {
        self.height += points;
        self.height - points
    }

    fn put(&mut self, element: std::fmt::Arguments) {
        if !matches!(self.parts.last(), Some(Part::Shapes(_))) {
            self.parts.push(Part::Shapes(String::new()));
        }
        if let Some(Part::Shapes(shapes)) = self.parts.last_mut() {
            // Writing to a string can't fail.
            let _ = shapes.write_fmt(element);
            shapes.push('\n');
        }
    }

    /// Draws a straight line.
    pub fn line(&mut self, from: Point, to: Point, stroke: Stroke) {
        self.path(&[from, to], stroke);
    }

    /// Draws a line through the points.
    pub fn path(&mut self, points: &[Point], stroke: Stroke) {
        let path = path_data(points);
        self.put(format_args!("<path d=\"{path}\" {}/>", stroke.attributes()));
    }

    /// Draws a line through the points with an arrow head at the last point. Fewer than two points draw nothing.
    pub fn arrow(&mut self, points: &[Point], stroke: Stroke) {
        let [.., before, tip] = points else { return };
        let (dx, dy) = (tip[0] - before[0], tip[1] - before[1]);
        let length = dx.hypot(dy).max(1e-9);
        let (dx, dy) = (dx / length, dy / length);
        let (long, wide) = (3.2 + stroke.width, 1.3 + stroke.width * 0.6);
        let neck = [tip[0] - dx * long, tip[1] - dy * long];
        let mut shaft = points[..points.len() - 1].to_vec();
        shaft.push([tip[0] - dx * long * 0.8, tip[1] - dy * long * 0.8]);
        self.path(&shaft, stroke);
        let head =
            [*tip, [neck[0] - dy * wide, neck[1] + dx * wide], [neck[0] + dy * wide, neck[1] - dx * wide]];
        self.area(&head, stroke.color, 1.0);
    }

    /// Draws a filled polygon. The opacity is 0 to 1.
    pub fn area(&mut self, points: &[Point], color: &str, opacity: f64) {
        let path = path_data(points);
        let opacity =
            if opacity < 1.0 { format!(" fill-opacity=\"{}\"", number(opacity)) } else { String::new() };
        self.put(format_args!("<path d=\"{path}Z\" fill=\"{color}\"{opacity}/>"));
    }

    /// Draws a rectangle. `corner` is its upper left corner, and `radius` rounds its corners. Lengths are in points.
    pub fn rectangle(
        &mut self,
        corner: Point,
        size: [f64; 2],
        radius: f64,
        fill: &str,
        border: Option<Stroke>,
    ) {
        let [x, y] = corner.map(number);
        let [width, height] = size.map(number);
        let radius = if radius > 0.0 { format!(" rx=\"{}\"", number(radius)) } else { String::new() };
        let stroke = border.map_or(String::new(), |stroke| {
            format!(" stroke=\"{}\" stroke-width=\"{}\"", stroke.color, number(stroke.width))
        });
        self.put(format_args!(
            "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"{radius} fill=\"{fill}\"{stroke}/>"
        ));
    }

    /// Draws a data point of this radius in points. A hollow point is white with a rim of the color.
    pub fn mark(&mut self, mark: Mark, center: Point, radius: f64, color: &'static str, hollow: bool) {
        let rim = 0.9;
        let (fill, radius) = if hollow { (WHITE, radius - rim / 2.0) } else { (color, radius) };
        let stroke = hollow.then_some(Stroke::new(color, rim));
        match mark {
            Mark::Square => {
                let side = radius * 1.8;
                self.rectangle(
                    [center[0] - side / 2.0, center[1] - side / 2.0],
                    [side; 2],
                    0.0,
                    fill,
                    stroke,
                );
            }
            Mark::Disc => {
                let [x, y] = center.map(number);
                let stroke = stroke.map_or(String::new(), |stroke| {
                    format!(" stroke=\"{}\" stroke-width=\"{}\"", stroke.color, number(stroke.width))
                });
                self.put(format_args!(
                    "<circle cx=\"{x}\" cy=\"{y}\" r=\"{}\" fill=\"{fill}\"{stroke}/>",
                    number(radius)
                ));
            }
            Mark::Diamond => {
                let reach = radius * 1.35;
                self.polygon(
                    center,
                    &[[0.0, -reach], [reach, 0.0], [0.0, reach], [-reach, 0.0]],
                    fill,
                    stroke,
                );
            }
            Mark::Triangle => {
                let (half, down) = (radius * 1.2, radius * 0.85);
                self.polygon(center, &[[0.0, -radius * 1.25], [half, down], [-half, down]], fill, stroke);
            }
            Mark::Cross => {
                let reach = radius * 0.9;
                for slope in [-reach, reach] {
                    let [x, y] = center;
                    self.line([x - reach, y - slope], [x + reach, y + slope], Stroke::new(color, rim));
                }
            }
        }
    }

    /// Draws a polygon whose corners are given from its center.
    fn polygon(&mut self, center: Point, corners: &[Point], fill: &str, border: Option<Stroke>) {
        let corners: Vec<Point> =
            corners.iter().map(|corner| [center[0] + corner[0], center[1] + corner[1]]).collect();
        let stroke = border.map_or(String::new(), |stroke| {
            format!(" stroke=\"{}\" stroke-width=\"{}\"", stroke.color, number(stroke.width))
        });
        let path = path_data(&corners);
        self.put(format_args!("<path d=\"{path}Z\" fill=\"{fill}\"{stroke}/>"));
    }

    /// Draws many small data points, `size` points wide. They are spread over a few SVG elements, which keeps the file
    /// small. The color is denser where points of several elements overlap.
    pub fn cloud(&mut self, mark: Mark, points: &[Point], size: f64, color: &str, opacity: f64) {
        const LAYERS: usize = 8;
        let cap = if mark == Mark::Disc { "round" } else { "square" };
        for layer in 0..LAYERS.min(points.len()) {
            let mut path = String::new();
            for [x, y] in points.iter().skip(layer).step_by(LAYERS) {
                // The line itself is too short to be seen, but its caps are as wide as the stroke.
                let _ = write!(path, "M{} {}h.01", number(*x), number(*y));
            }
            self.put(format_args!(
                "<path d=\"{path}\" fill=\"none\" stroke=\"{color}\" stroke-opacity=\"{}\" stroke-width=\"{}\" \
                 stroke-linecap=\"{cap}\"/>",
                number(opacity),
                number(size),
            ));
        }
    }

    /// Writes a line of text with its base line at the point. In the text, `_{…}` is a subscript, `^{…}` a superscript,
    /// and `*…*` italic.
    pub fn text(&mut self, text: &str, at: Point, how: Type) {
        // Some ticks have no word, which a screen reader would announce.
        if text.is_empty() {
            return;
        }
        let line = text::line(text, how.face, how.size);
        self.parts.push(Part::Text(Text { line, at, how }));
    }

    /// Places a picture with its upper left corner at `corner`, scaled to `size` points. With `crisp`, an enlarged
    /// picture's pixels stay sharp squares.
    ///
    /// # Errors
    /// When the picture can't be encoded as PNG.
    pub fn picture(
        &mut self,
        picture: &RgbImage,
        corner: Point,
        size: [f64; 2],
        crisp: bool,
    ) -> Result<(), FigureError> {
        let mut png = Cursor::new(Vec::new());
        DynamicImage::from(picture.clone())
            .write_to(&mut png, ImageFormat::Png)
            .map_err(|error| FigureError::Picture(error.to_string()))?;
        // Browsers treat this value as `pixelated`. resvg understands `pixelated` only in a `style` attribute.
        let rendering = if crisp { " image-rendering=\"optimizeSpeed\"" } else { "" };
        let [x, y] = corner.map(number);
        let [width, height] = size.map(number);
        self.put(format_args!(
            "<image x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\" \
             preserveAspectRatio=\"none\"{rendering} href=\"data:image/png;base64,{}\"/>",
            BASE64.encode(png.get_ref())
        ));
        Ok(())
    }

    /// The page as an SVG document.
    pub fn svg(&self) -> String {
        let (width, height) = (number(self.width), number(self.height));
        let title = escaped(&self.title);
        let mut svg = format!("{}<title>{title}</title>\n<defs>\n", self.head());
        let texts = self.parts.iter().filter_map(|part| match part {
            Part::Text(text) => Some(&text.line.glyphs),
            Part::Shapes(_) => None,
        });
        let glyphs: BTreeSet<(Face, u32)> = texts.flatten().map(|glyph| (glyph.face, glyph.id)).collect();
        let has_outline = |(face, id): &&(Face, u32)| !text::outline(*face, *id).is_empty();
        for (face, id) in glyphs.iter().filter(has_outline) {
            let _ = writeln!(
                svg,
                "<path id=\"{}\" d=\"{}\"/>",
                glyph_name(*face, *id),
                text::outline(*face, *id)
            );
        }
        let _ = write!(svg, "</defs>\n<rect width=\"{width}\" height=\"{height}\" fill=\"{WHITE}\"/>\n");
        for part in &self.parts {
            match part {
                Part::Shapes(shapes) => svg.push_str(shapes),
                Part::Text(text) => svg.push_str(&text.svg()),
            }
        }
        svg.push_str("</svg>\n");
        svg
    }

    /// The beginning of the page's SVG document.
    fn head(&self) -> String {
        let (width, height, title) = (number(self.width), number(self.height), escaped(&self.title));
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}pt\" height=\"{height}pt\" \
             viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{title}\">\n"
        )
    }

    /// The parts of the page, from the lowest to the highest.
    pub(super) fn parts(&self) -> &[Part] {
        &self.parts
    }

    /// The words that describe the page to screen readers.
    pub(super) fn title(&self) -> &str {
        &self.title
    }

    /// The width and the height of the page, points.
    pub(super) fn size(&self) -> [f64; 2] {
        [self.width, self.height]
    }

    /// SVG elements as the only ones of the page.
    ///
    /// # Errors
    /// When they aren't valid SVG.
    pub(super) fn with_only(&self, shapes: &str) -> Result<usvg::Tree, usvg::Error> {
        usvg::Tree::from_str(&format!("{}{shapes}</svg>", self.head()), &usvg::Options::default())
    }

    /// Renders the SVG document `svg` as a PNG of 600 pixels per inch and returns the file's bytes.
    ///
    /// # Errors
    /// When the document isn't valid SVG, has no size, or the PNG can't be encoded.
    pub fn png(svg: &str) -> Result<Vec<u8>, FigureError> {
        let picture = Self::picture_of(svg, PNG_SCALE)?;
        let rgb: Vec<[u8; 3]> = picture.pixels().map(|pixel| pixel.0).collect();
        encoded([picture.width(), picture.height()], &rgb)
            .map_err(|error| FigureError::Picture(error.to_string()))
    }

    /// Renders the SVG document `svg` with `scale` pixels per point.
    ///
    /// # Errors
    /// When the document isn't valid SVG, or has no size.
    pub fn picture_of(svg: &str, scale: f32) -> Result<RgbImage, FigureError> {
        let failed = |reason: String| FigureError::Picture(reason);
        let tree = usvg::Tree::from_str(svg, &usvg::Options::default())
            .map_err(|error| failed(error.to_string()))?;
        // usvg has 96 units per inch.
        let scale = 0.75 * scale;
        let [width, height] =
            [tree.size().width(), tree.size().height()].map(|side| (side * scale).round() as u32);
        let mut pixels =
            tiny_skia::Pixmap::new(width, height).ok_or_else(|| failed("the page has no size".into()))?;
        // The page may cover the last row or column only in part.
        pixels.fill(tiny_skia::Color::WHITE);
        resvg::render(&tree, tiny_skia::Transform::from_scale(scale, scale), &mut pixels.as_mut());
        // The page is opaque, so the alpha channel can be dropped.
        let rgb =
            pixels.pixels().iter().flat_map(|pixel| [pixel.red(), pixel.green(), pixel.blue()]).collect();
        RgbImage::from_raw(width, height, rgb).ok_or_else(|| failed("the page has no size".into()))
    }
}

/// Largest number of colors in a PNG's palette.
const PALETTE: usize = 256;
/// Largest allowed distance of a color from the nearest color of the palette, with intensities from 0 to 255. Only
/// the few pixels of rare shades at edges change, so the difference isn't visible.
const FARTHEST: u32 = 48;

/// Encodes pixels as a PNG. If the most frequent colors are close enough to all others, the PNG has a palette of
/// them, which halves the file of a drawing.
fn encoded([width, height]: [u32; 2], pixels: &[[u8; 3]]) -> Result<Vec<u8>, png::EncodingError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_compression(png::Compression::High);
    let data = match palette(pixels) {
        Some((colors, places)) => {
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_palette(colors.as_flattened().to_vec());
            encoder.set_filter(png::Filter::NoFilter);
            pixels.iter().map(|pixel| places[pixel]).collect()
        }
        None => {
            encoder.set_color(png::ColorType::Rgb);
            encoder.set_filter(png::Filter::Adaptive);
            pixels.as_flattened().to_vec()
        }
    };
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&data)?;
    writer.finish()?;
    Ok(bytes)
}

/// The intensities of red, green and blue.
type Rgb = [u8; 3];

/// Returns the most frequent colors, and the index of the nearest of them for each color. Returns `None` if a color
/// is farther than [`FARTHEST`] from its nearest one.
fn palette(pixels: &[Rgb]) -> Option<(Vec<Rgb>, BTreeMap<Rgb, u8>)> {
    let mut counts: BTreeMap<Rgb, usize> = BTreeMap::new();
    for run in pixels.chunk_by(|a, b| a == b) {
        *counts.entry(run[0]).or_default() += run.len();
    }
    let mut colors: Vec<Rgb> = counts.keys().copied().collect();
    colors.sort_by_key(|color| Reverse(counts[color]));
    colors.truncate(PALETTE);
    let nearest = |color: &Rgb| {
        let distance = |other: &Rgb| -> u32 {
            color.iter().zip(other).map(|(a, b)| u32::from(a.abs_diff(*b)).pow(2)).sum()
        };
        let distances = (0..=u8::MAX).zip(&colors).map(|(place, other)| (distance(other), place));
        distances.min().filter(|(distance, _)| *distance <= FARTHEST.pow(2)).map(|(_, place)| place)
    };
    let places = counts.keys().map(|color| Some((*color, nearest(color)?))).collect::<Option<_>>()?;
    Some((colors, places))
}

fn path_data(points: &[Point]) -> String {
    let mut path = String::new();
    for (index, [x, y]) in points.iter().enumerate() {
        let _ = write!(path, "{}{} {}", if index == 0 { 'M' } else { 'L' }, number(*x), number(*y));
    }
    path
}

/// A glyph's `id` in the SVG document. It is the same in every figure, so that an HTML page can hold several figures.
fn glyph_name(face: Face, id: u32) -> String {
    format!("{}{id}", ["r", "b", "i"][face as usize])
}

/// A number with at most two decimals, without trailing zeros.
fn number(value: f64) -> String {
    let text = format!("{value:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.into() }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
