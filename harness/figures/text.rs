//! Text as outlines of a font that is part of the program, so that a figure looks the same on every machine.

use skrifa::instance::{LocationRef, Size};
use skrifa::outline::{DrawSettings, OutlinePen};
use skrifa::{FontRef, GlyphId, MetadataProvider};
use std::fmt::Write;
use std::sync::LazyLock;

/// A style of the font.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Face {
    Regular,
    Bold,
    Italic,
}

/// A letter's place in a line of text.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Glyph {
    pub face: Face,
    pub id: u32,
    /// Distance from the line's beginning, points.
    pub x: f64,
    /// Height above the line, points.
    pub rise: f64,
    /// Of the letters, points.
    pub size: f64,
}

/// A line of text, laid out.
pub struct Line {
    pub glyphs: Vec<Glyph>,
    /// Points.
    pub width: f64,
    /// The text without its markup.
    pub plain: String,
}

/// Letters of a subscript or superscript are smaller by this factor.
const SCRIPT: f64 = 0.72;

static FONTS: LazyLock<[FontRef<'static>; 3]> = LazyLock::new(|| {
    let font = |bytes: &'static [u8]| FontRef::new(bytes).expect("the fonts are part of the program");
    [
        font(include_bytes!("fonts/Roboto-Regular.ttf")),
        font(include_bytes!("fonts/Roboto-Bold.ttf")),
        font(include_bytes!("fonts/Roboto-Italic.ttf")),
    ]
});

/// Units of the fonts in which outlines are drawn, to the em.
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

/// A letter's glyph and its advance in units of the font; the empty box of glyph 0 where the font lacks it.
fn glyph(face: Face, letter: char) -> (u32, f64) {
    let font = &FONTS[face as usize];
    let id = font.charmap().map(letter).unwrap_or(GlyphId::NOTDEF);
    let advance = font.glyph_metrics(Size::unscaled(), LocationRef::default()).advance_width(id);
    (id.to_u32(), f64::from(advance.unwrap_or_default()))
}

/// A glyph's outline as SVG path data, in units of the font with y upwards.
pub fn outline(face: Face, id: u32) -> String {
    let mut pen = Path::default();
    if let Some(glyph) = FONTS[face as usize].outline_glyphs().get(GlyphId::new(id)) {
        let settings = DrawSettings::unhinted(Size::unscaled(), LocationRef::default());
        // Only a damaged font fails, and the fonts are part of the program.
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
