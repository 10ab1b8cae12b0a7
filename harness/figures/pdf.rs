//! Writes a page as PDF. Its text is text in fonts that are part of the document, so that it can be searched and copied.

use super::page::{Page, Part, Text};
use super::text::FILES;
use krilla::Document;
use krilla::color::rgb;
use krilla::geom::{self, PathBuilder, Size, Transform};
use krilla::image::Image;
use krilla::metadata::Metadata;
use krilla::num::NormalizedF32;
use krilla::page::PageSettings;
use krilla::paint::{Fill, FillRule, LineCap, Stroke, StrokeDash};
use krilla::surface::Surface;
use krilla::text::{Font, GlyphId, KrillaGlyph};
use resvg::tiny_skia::PathSegment;
use resvg::usvg::{self, ImageKind, ImageRendering, Node, Paint};

/// Points per unit of a document that usvg has read.
const POINTS: f32 = 0.75;

/// Returns the PDF of a page.
///
/// # Errors
/// When a part can't be read, has something that no page has, or the PDF can't be written. The message says why.
pub fn write(from: &Page) -> Result<Vec<u8>, String> {
    let [width, height] = from.size();
    let settings = PageSettings::from_wh(width as f32, height as f32).ok_or("the page has no size")?;
    let fonts = FILES.map(|file| Font::new(file.into(), 0));
    let [Some(regular), Some(bold), Some(italic)] = fonts else { return Err("a font can't be read".into()) };
    let fonts = [regular, bold, italic];
    let mut pdf = Document::new();
    pdf.set_metadata(Metadata::new().title(from.title().to_owned()));
    let mut page = pdf.start_page_with(settings);
    let mut surface = page.surface();
    for part in from.parts() {
        match part {
            Part::Shapes(shapes) => {
                let tree = from.with_only(shapes).map_err(|error| error.to_string())?;
                surface.push_transform(&Transform::from_scale(POINTS, POINTS));
                draw_nodes(&mut surface, tree.root().children())?;
                surface.pop();
            }
            Part::Text(text) => draw_text(&mut surface, text, &fonts)?,
        }
    }
    surface.finish();
    page.finish();
    pdf.finish().map_err(|error| format!("{error:?}"))
}

/// Draws the paths and images of a document. The pages of figures have neither clips nor masks.
fn draw_nodes(surface: &mut Surface, nodes: &[Node]) -> Result<(), String> {
    for node in nodes {
        match node {
            Node::Group(group) => draw_nodes(surface, group.children())?,
            Node::Path(path) => {
                let Some(shape) = shape_of(path.data()) else { continue };
                surface.push_transform(&transform(path.abs_transform()));
                surface.set_fill(path.fill().map(fill).transpose()?);
                surface.set_stroke(path.stroke().map(stroke).transpose()?);
                surface.draw_path(&shape);
                surface.pop();
            }
            Node::Image(image) => {
                let ImageKind::PNG(bytes) = image.kind() else { return Err("a picture is no PNG".into()) };
                let is_smooth = image.rendering_mode() == ImageRendering::OptimizeQuality;
                let (width, height) = (image.size().width(), image.size().height());
                let size = Size::from_wh(width, height).ok_or("a picture has no size")?;
                surface.push_transform(&transform(image.abs_transform()));
                surface.draw_image(Image::from_png(bytes.clone().into(), is_smooth)?, size);
                surface.pop();
            }
            Node::Text(_) => return Err("a text is not part of the shapes".into()),
        }
    }
    Ok(())
}

/// Draws a line of text. Letters of one font and size that follow one another are one piece.
fn draw_text(surface: &mut Surface, text: &Text, fonts: &[Font; 3]) -> Result<(), String> {
    surface.push_transform(&placement(text));
    surface.set_stroke(None);
    surface.set_fill(Some(Fill { paint: color(text.how.color)?.into(), ..Fill::default() }));
    let letters: Vec<(usize, char)> = text.line.plain.char_indices().collect();
    let mut first = 0;
    let like = |a: usize, b: usize| {
        let [a, b] = [a, b].map(|place| &text.line.glyphs[place]);
        (a.face, a.size, a.rise) == (b.face, b.size, b.rise)
    };
    while first < letters.len() {
        let end = (first + 1..letters.len()).find(|place| !like(first, *place)).unwrap_or(letters.len());
        let glyphs = &text.line.glyphs[first..end];
        let (at, size) = (&glyphs[0], glyphs[0].size);
        let width = |place: usize| text.line.glyphs.get(place + 1).map_or(text.line.width, |next| next.x);
        let begin = letters[first].0;
        let piece: Vec<KrillaGlyph> = (first..end)
            .map(|place| {
                let (glyph, (byte, letter)) = (&text.line.glyphs[place], letters[place]);
                let advance = ((width(place) - glyph.x) / size) as f32;
                let range = byte - begin..byte - begin + letter.len_utf8();
                KrillaGlyph::new(GlyphId::new(glyph.id), advance, 0.0, 0.0, 0.0, range, None)
            })
            .collect();
        let words = &text.line.plain[begin..letters.get(end).map_or(text.line.plain.len(), |next| next.0)];
        let start = geom::Point::from_xy((text.start() + at.x) as f32, -at.rise as f32);
        surface.draw_glyphs(start, &piece, fonts[at.face as usize].clone(), words, size as f32, false);
        first = end;
    }
    surface.pop();
    Ok(())
}

/// The position and rotation of a line of text.
fn placement(text: &Text) -> Transform {
    let [x, y] = text.at.map(|length| length as f32);
    // Upright text reads upwards: to the right along the line is up on the page.
    if text.how.upright {
        Transform::from_row(0.0, -1.0, 1.0, 0.0, x, y)
    } else {
        Transform::from_translate(x, y)
    }
}

/// The color that SVG writes as `#rrggbb`.
fn color(text: &str) -> Result<rgb::Color, String> {
    let value = |range| u8::from_str_radix(text.get(range).unwrap_or_default(), 16);
    match (value(1..3), value(3..5), value(5..7)) {
        (Ok(red), Ok(green), Ok(blue)) => Ok(rgb::Color::new(red, green, blue)),
        _ => Err(format!("'{text}' is no color")),
    }
}

fn painted(paint: &Paint) -> Result<rgb::Color, String> {
    match paint {
        Paint::Color(color) => Ok(rgb::Color::new(color.red, color.green, color.blue)),
        _ => Err("a shape has no plain color".into()),
    }
}

fn opacity(of: usvg::Opacity) -> NormalizedF32 {
    NormalizedF32::new(of.get()).unwrap_or(NormalizedF32::ONE)
}

fn fill(of: &usvg::Fill) -> Result<Fill, String> {
    let rule = match of.rule() {
        usvg::FillRule::NonZero => FillRule::NonZero,
        usvg::FillRule::EvenOdd => FillRule::EvenOdd,
    };
    Ok(Fill { paint: painted(of.paint())?.into(), opacity: opacity(of.opacity()), rule })
}

fn stroke(of: &usvg::Stroke) -> Result<Stroke, String> {
    let line_cap = match of.linecap() {
        usvg::LineCap::Butt => LineCap::Butt,
        usvg::LineCap::Round => LineCap::Round,
        usvg::LineCap::Square => LineCap::Square,
    };
    let dash = of.dasharray().map(|array| StrokeDash { array: array.to_vec(), offset: of.dashoffset() });
    Ok(Stroke {
        paint: painted(of.paint())?.into(),
        width: of.width().get(),
        line_cap,
        opacity: opacity(of.opacity()),
        dash,
        ..Stroke::default()
    })
}

fn transform(of: usvg::Transform) -> Transform {
    Transform::from_row(of.sx, of.ky, of.kx, of.sy, of.tx, of.ty)
}

fn shape_of(path: &resvg::tiny_skia::Path) -> Option<geom::Path> {
    let mut builder = PathBuilder::new();
    for segment in path.segments() {
        match segment {
            PathSegment::MoveTo(to) => builder.move_to(to.x, to.y),
            PathSegment::LineTo(to) => builder.line_to(to.x, to.y),
            PathSegment::QuadTo(by, to) => builder.quad_to(by.x, by.y, to.x, to.y),
            PathSegment::CubicTo(a, b, to) => builder.cubic_to(a.x, a.y, b.x, b.y, to.x, to.y),
            PathSegment::Close => builder.close(),
        }
    }
    builder.finish()
}
