//! Lays out text with a font that is part of the program. Figures contain the glyphs' outlines, so that they look the
//! same on every machine.

use skrifa::instance::{LocationRef, Size};
use skrifa::outline::{DrawSettings, OutlinePen};
use skrifa::{FontRef, GlyphId, MetadataProvider};
use std::fmt::Write;
use std::sync::LazyLock;

/// A style of the font.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Face {
    /// Upright letters of normal weight.
    Regular,
    /// Upright bold letters.
    Bold,
    /// Slanted letters of normal weight.
    Italic,
}

/// A letter's place in a line of text.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Glyph {
    /// The style of the font that has the glyph.
    pub face: Face,
    /// The glyph's number in the font.
    pub id: u32,
    /// Distance from the line's beginning, points.
    pub x: f64,
    /// Height above the line, points.
    pub rise: f64,
    /// The font's size, points. It is smaller in subscripts and superscripts.
    pub size: f64,
}

/// A line of text, laid out.
pub struct Line {
    /// The line's letters from left to right.
    pub glyphs: Vec<Glyph>,
    /// The line's width, points.
    pub width: f64,
    /// The text without its markup.
    pub plain: String,
}

/// The size of letters in subscripts and superscripts, relative to the other letters.
const SCRIPT: f64 = 0.72;

/// The files of the font, in the order of [`Face`].
pub const FILES: [&[u8]; 3] = [
    include_bytes!("fonts/Roboto-Regular.ttf"),
    include_bytes!("fonts/Roboto-Bold.ttf"),
    include_bytes!("fonts/Roboto-Italic.ttf"),
];

static FONTS: LazyLock<[FontRef<'static>; 3]> =
    LazyLock::new(|| FILES.map(|file| FontRef::new(file).expect("the fonts are part of the program")));

/// Number of font units per em. Outlines are in these units.
pub const EM: f64 = 2048.0;

/// Lays out a line in letters of `size` points. In the text, `_{…}` is a subscript, `^{…}` a superscript, and
/// `*…*` italic.
pub fn line(text: &str, face: Face, size: f64) -> Line {
    let mut line = Line { glyphs: Vec::new(), width: 0.0, plain: String::new() };
    let (mut now, mut rise, mut scale) = (face, 0.0, 1.0);
    let mut letters = text.chars().peekable();
    while let Some(letter) = letters.next() {
        match letter {
            '_' | '^' if letters.peek() == Some(&'{') => {
                letters.next();
                (rise, scale) = (if letter == '_' { -0.18 } else { 0.35 } * size, SCRIPT);
            }
            '}' => (rise, scale) = (0.0, 1.0),
            '*' => now = if now == Face::Italic { face } else { Face::Italic },
            letter => {
                let (id, advance) = glyph(now, letter);
                line.glyphs.push(Glyph { face: now, id, x: line.width, rise, size: size * scale });
                line.width += advance * size * scale / EM;
                line.plain.push(letter);
            }
        }
    }
    line
}

/// The number of a letter's glyph, and its advance in font units. A letter that the font lacks becomes glyph 0, an
/// empty box.
fn glyph(face: Face, letter: char) -> (u32, f64) {
    let font = &FONTS[face as usize];
    let id = font.charmap().map(letter).unwrap_or(GlyphId::NOTDEF);
    let advance = font.glyph_metrics(Size::unscaled(), LocationRef::default()).advance_width(id);
    (id.to_u32(), f64::from(advance.unwrap_or_default()))
}

/// A glyph's outline as SVG path data, in font units ([`EM`]). `y` grows upwards.
pub fn outline(face: Face, id: u32) -> String {
    let mut pen = Path::default();
    if let Some(glyph) = FONTS[face as usize].outline_glyphs().get(GlyphId::new(id)) {
        let settings = DrawSettings::unhinted(Size::unscaled(), LocationRef::default());
        // Drawing fails only if the font is damaged, and the fonts are part of the program.
        let _ = glyph.draw(settings, &mut pen);
    }
    pen.0
}

#[derive(Default)]
struct Path(String);

impl Path {
    fn put(&mut self, command: char, points: &[f32]) {
        self.0.push(command);
        for (index, point) in points.iter().enumerate() {
            let gap = if index > 0 { " " } else { "" };
            let _ = write!(self.0, "{gap}{}", point.round());
        }
    }
}

impl OutlinePen for Path {
    fn move_to(&mut self, x: f32, y: f32) {
        self.put('M', &[x, y]);
    }

    fn line_to(&mut self, x: f32, y: f32) {
        self.put('L', &[x, y]);
    }

    fn quad_to(&mut self, cx: f32, cy: f32, x: f32, y: f32) {
        self.put('Q', &[cx, cy, x, y]);
    }

    fn curve_to(&mut self, ax: f32, ay: f32, bx: f32, by: f32, x: f32, y: f32) {
        self.put('C', &[ax, ay, bx, by, x, y]);
    }

    fn close(&mut self) {
        self.0.push('Z');
    }
}
