//! A page to draw on: shapes, text and pictures in points, as SVG, and as PNG made of that SVG.
//!
//! A plotting library would serve four of the nine figures; pictures with labels, grids of frames and diagrams of
//! networks need a page like this one anyway, and axes on it are a small step ([`super::axes`]).

use super::FigureError;
use super::text::{self, EM, Face};
use base64::Engine;
use base64::engine::general_purpose::STANDARD as BASE64;
use image::{DynamicImage, ImageFormat, RgbImage};
use resvg::{tiny_skia, usvg};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::io::Cursor;

/// Width of a journal's column: 8.5 cm in points.
pub const COLUMN: f64 = 241.0;
/// Pixels a point of the PNG, 600 a inch.
const PNG_SCALE: f32 = 600.0 / 72.0;

pub const BLACK: &str = "#1a1a1a";
pub const GREY: &str = "#767676";
pub const PALE: &str = "#e4e4e4";
pub const WHITE: &str = "#ffffff";
/// Of Okabe and Ito's palette, which the colour-blind can tell apart.
pub const BLUE: &str = "#0072b2";
pub const VERMILION: &str = "#d55e00";
pub const GREEN: &str = "#009e73";
/// Of Tol's, to go with green.
pub const WINE: &str = "#882255";

/// A place, points from the page's upper left corner.
pub type Point = [f64; 2];

/// How a line is drawn.
#[derive(Debug, Clone, Copy)]
pub struct Stroke {
    pub colour: &'static str,
    /// Points.
    pub width: f64,
    pub dashed: bool,
}

impl Stroke {
    pub const fn new(colour: &'static str, width: f64) -> Self {
        Self { colour, width, dashed: false }
    }

    pub const fn dashed(self) -> Self {
        Self { dashed: true, ..self }
    }

    fn attributes(&self) -> String {
        let dash = if self.dashed {
            format!(" stroke-dasharray=\"{} {}\"", number(self.width * 2.6), number(self.width * 1.8))
        } else {
            String::new()
        };
        format!("fill=\"none\" stroke=\"{}\" stroke-width=\"{}\"{dash}", self.colour, number(self.width))
    }
}

/// Where a text stands from its point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Anchor {
    Start,
    Middle,
    End,
}

/// How a text is set.
#[derive(Debug, Clone, Copy)]
pub struct Type {
    /// Points.
    pub size: f64,
    pub face: Face,
    pub colour: &'static str,
    pub anchor: Anchor,
    /// Reads upwards.
    pub upright: bool,
}

impl Type {
    /// What axes are labelled with.
    pub const LABEL: Type =
        Type { size: 7.0, face: Face::Regular, colour: BLACK, anchor: Anchor::Middle, upright: false };
    /// Numbers at ticks, and notes.
    pub const SMALL: Type = Type { size: 6.2, ..Self::LABEL };
    /// Headings.
    pub const BOLD: Type = Type { size: 7.5, face: Face::Bold, anchor: Anchor::Start, ..Self::LABEL };

    pub const fn start(self) -> Self {
        Self { anchor: Anchor::Start, ..self }
    }

    pub const fn end(self) -> Self {
        Self { anchor: Anchor::End, ..self }
    }

    pub const fn middle(self) -> Self {
        Self { anchor: Anchor::Middle, ..self }
    }

    pub const fn colour(self, colour: &'static str) -> Self {
        Self { colour, ..self }
    }

    pub const fn upright(self) -> Self {
        Self { upright: true, ..self }
    }

    /// The width of a text, points.
    pub fn width(&self, text: &str) -> f64 {
        text::line(text, self.face, self.size).width
    }
}

/// The shape of a data point.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    Disc,
    Square,
}

/// A page.
pub struct Page {
    width: f64,
    height: f64,
    title: String,
    body: String,
    glyphs: BTreeSet<(Face, u32)>,
}

impl Page {
    /// An empty page of this size, points; the title says what is on it to those who can't see it.
    pub fn new(width: f64, height: f64, title: &str) -> Self {
        Self { width, height, title: title.to_owned(), body: String::new(), glyphs: BTreeSet::new() }
    }

    fn put(&mut self, element: std::fmt::Arguments) {
        // Writing to a string doesn't fail.
        let _ = self.body.write_fmt(element);
        self.body.push('\n');
    }

    pub fn line(&mut self, from: Point, to: Point, stroke: Stroke) {
        self.path(&[from, to], stroke);
    }

    /// A line through the points.
    pub fn path(&mut self, points: &[Point], stroke: Stroke) {
        let path = path_data(points);
        self.put(format_args!("<path d=\"{path}\" {}/>", stroke.attributes()));
    }

    /// A line through the points with a head at its last.
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
        self.area(&head, stroke.colour, 1.0);
    }

    /// A filled polygon.
    pub fn area(&mut self, points: &[Point], colour: &str, opacity: f64) {
        let path = path_data(points);
        let opacity =
            if opacity < 1.0 { format!(" fill-opacity=\"{}\"", number(opacity)) } else { String::new() };
        self.put(format_args!("<path d=\"{path}Z\" fill=\"{colour}\"{opacity}/>"));
    }

    /// A rectangle with rounded corners.
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
            format!(" stroke=\"{}\" stroke-width=\"{}\"", stroke.colour, number(stroke.width))
        });
        self.put(format_args!(
            "<rect x=\"{x}\" y=\"{y}\" width=\"{width}\" height=\"{height}\"{radius} fill=\"{fill}\"{stroke}/>"
        ));
    }

    /// A data point, `radius` points wide to each side; hollow ones have a rim of the colour.
    pub fn mark(&mut self, mark: Mark, centre: Point, radius: f64, colour: &'static str, hollow: bool) {
        let rim = 0.9;
        let (fill, radius) = if hollow { (WHITE, radius - rim / 2.0) } else { (colour, radius) };
        let stroke = hollow.then_some(Stroke::new(colour, rim));
        match mark {
            Mark::Square => {
                let side = radius * 1.8;
                self.rectangle(
                    [centre[0] - side / 2.0, centre[1] - side / 2.0],
                    [side; 2],
                    0.0,
                    fill,
                    stroke,
                );
            }
            Mark::Disc => {
                let [x, y] = centre.map(number);
                let stroke = stroke.map_or(String::new(), |stroke| {
                    format!(" stroke=\"{}\" stroke-width=\"{}\"", stroke.colour, number(stroke.width))
                });
                self.put(format_args!(
                    "<circle cx=\"{x}\" cy=\"{y}\" r=\"{}\" fill=\"{fill}\"{stroke}/>",
                    number(radius)
                ));
            }
        }
    }

    /// Many small data points, in a few elements: where points of several elements overlap, the colour is denser.
    pub fn cloud(&mut self, mark: Mark, points: &[Point], size: f64, colour: &str, opacity: f64) {
        const LAYERS: usize = 8;
        let cap = if mark == Mark::Disc { "round" } else { "square" };
        for layer in 0..LAYERS.min(points.len()) {
            let mut path = String::new();
            for [x, y] in points.iter().skip(layer).step_by(LAYERS) {
                // A line too short to be seen has caps of the line's width.
                let _ = write!(path, "M{} {}h.01", number(*x), number(*y));
            }
            self.put(format_args!(
                "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-opacity=\"{}\" stroke-width=\"{}\" \
                 stroke-linecap=\"{cap}\"/>",
                number(opacity),
                number(size),
            ));
        }
    }

    /// A line of text; the point lies on its base line. See [`text::line`] for the markup.
    pub fn text(&mut self, text: &str, at: Point, how: Type) {
        let line = text::line(text, how.face, how.size);
        let shift = match how.anchor {
            Anchor::Start => 0.0,
            Anchor::Middle => -line.width / 2.0,
            Anchor::End => -line.width,
        };
        let turn = if how.upright { " rotate(-90)" } else { "" };
        let [x, y] = at.map(number);
        self.put(format_args!(
            "<g role=\"img\" aria-label=\"{}\" fill=\"{}\" transform=\"translate({x} {y}){turn}\">",
            escaped(&line.plain),
            how.colour
        ));
        for glyph in &line.glyphs {
            if text::outline(glyph.face, glyph.id).is_empty() {
                continue;
            }
            self.glyphs.insert((glyph.face, glyph.id));
            let scale = glyph.size / EM;
            let _ = write!(
                self.body,
                "<use href=\"#{}\" transform=\"matrix({scale:.5} 0 0 {:.5} {} {})\"/>",
                glyph_name(glyph.face, glyph.id),
                -scale,
                number(shift + glyph.x),
                number(-glyph.rise),
            );
        }
        self.put(format_args!("</g>"));
    }

    /// A picture; its pixels stay squares where it is enlarged, if `crisp`.
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
        // What browsers take for `pixelated`, which resvg takes in a style alone.
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
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width}pt\" height=\"{height}pt\" \
             viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{title}\">\n<title>{title}</title>\n<defs>\n"
        );
        for (face, id) in &self.glyphs {
            let _ = writeln!(
                svg,
                "<path id=\"{}\" d=\"{}\"/>",
                glyph_name(*face, *id),
                text::outline(*face, *id)
            );
        }
        let _ = write!(
            svg,
            "</defs>\n<rect width=\"{width}\" height=\"{height}\" fill=\"{WHITE}\"/>\n{}</svg>\n",
            self.body
        );
        svg
    }

    /// The SVG document `svg` as a PNG of 600 pixels an inch.
    pub fn png(svg: &str) -> Result<Vec<u8>, FigureError> {
        let failed = |reason: String| FigureError::Picture(reason);
        let tree = usvg::Tree::from_str(svg, &usvg::Options::default())
            .map_err(|error| failed(error.to_string()))?;
        let [width, height] =
            [tree.size().width(), tree.size().height()].map(|side| (side * 0.75 * PNG_SCALE).round() as u32);
        let mut pixels =
            tiny_skia::Pixmap::new(width, height).ok_or_else(|| failed("the page has no size".into()))?;
        // usvg counts 96 units an inch.
        let scale = 0.75 * PNG_SCALE;
        resvg::render(&tree, tiny_skia::Transform::from_scale(scale, scale), &mut pixels.as_mut());
        // The page is opaque.
        let rgb: Vec<[u8; 3]> =
            pixels.pixels().iter().map(|pixel| [pixel.red(), pixel.green(), pixel.blue()]).collect();
        encoded([width, height], &rgb).map_err(|error| failed(error.to_string()))
    }
}

/// The most colours that a palette can have.
const PALETTE: usize = 256;
/// How far a colour may be from the nearest of a palette, with intensities to 255: what nobody sees in the few pixels of rare shades at edges.
const FARTHEST: u32 = 48;

/// A PNG, with a palette of the most frequent colours where these are as good as all, which halves the file of a drawing.
fn encoded([width, height]: [u32; 2], pixels: &[[u8; 3]]) -> Result<Vec<u8>, png::EncodingError> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_compression(png::Compression::High);
    let data = match palette(pixels) {
        Some((colours, places)) => {
            encoder.set_color(png::ColorType::Indexed);
            encoder.set_palette(colours.as_flattened().to_vec());
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

/// Red, green and blue.
type Rgb = [u8; 3];

/// The most frequent colours, and the place of each colour's nearest among them; `None` where one is too far from it.
fn palette(pixels: &[Rgb]) -> Option<(Vec<Rgb>, BTreeMap<Rgb, u8>)> {
    let mut counts: BTreeMap<Rgb, usize> = BTreeMap::new();
    for run in pixels.chunk_by(|a, b| a == b) {
        *counts.entry(run[0]).or_default() += run.len();
    }
    let mut colours: Vec<Rgb> = counts.keys().copied().collect();
    colours.sort_by_key(|colour| Reverse(counts[colour]));
    colours.truncate(PALETTE);
    let nearest = |colour: &Rgb| {
        let distance = |other: &Rgb| -> u32 {
            colour.iter().zip(other).map(|(a, b)| u32::from(a.abs_diff(*b)).pow(2)).sum()
        };
        let distances = (0..=u8::MAX).zip(&colours).map(|(place, other)| (distance(other), place));
        distances.min().filter(|(distance, _)| *distance <= FARTHEST.pow(2)).map(|(_, place)| place)
    };
    let places = counts.keys().map(|colour| Some((*colour, nearest(colour)?))).collect::<Option<_>>()?;
    Some((colours, places))
}

fn path_data(points: &[Point]) -> String {
    let mut path = String::new();
    for (index, [x, y]) in points.iter().enumerate() {
        let _ = write!(path, "{}{} {}", if index == 0 { 'M' } else { 'L' }, number(*x), number(*y));
    }
    path
}

/// A glyph's name in the document; the same in every figure, so that several fit into one page.
fn glyph_name(face: Face, id: u32) -> String {
    format!("{}{id}", ["r", "b", "i"][face as usize])
}

/// A number to two decimals, as short as can be.
fn number(value: f64) -> String {
    let text = format!("{value:.2}");
    let text = text.trim_end_matches('0').trim_end_matches('.');
    if text == "-0" { "0".into() } else { text.into() }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
