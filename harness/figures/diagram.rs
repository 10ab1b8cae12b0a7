//! Draws the layers of a network. Two figures show such a diagram.

use super::anatomy::{Anatomy, Block, Lane, Part};
use super::axes;
use super::page::{BLACK, COLUMN, GRAY, Page, Point, Stroke, Type, WHITE};
use super::text::Face;
use harness_learning::network::description::{self, IMAGES, POSTERIOR, PRIOR, VECTORS};
use harness_spec::{Definition, IMAGE_CHANNELS, Task};

/// Fill color of inputs and outputs.
pub const INPUT: &str = "#d8ebf7";
/// Fill color of the latent state.
pub const LATENT: &str = "#fdebc8";
/// Fill color of the action.
pub const ACTION: &str = "#d5efe4";
/// Fill color of layers that aren't trained.
pub const FROZEN: &str = "#e2e2e2";
/// Stroke of the arrows between blocks.
pub const LINE: Stroke = Stroke::new(BLACK, 0.7);

/// Draws a box with centered lines of text. The first line is bold.
pub fn block(page: &mut Page, center: Point, size: [f64; 2], fill: &str, lines: &[String]) {
    boxed(page, center, size, fill, lines, |index| index == 0);
}

/// Draws a box with centered lines of text, of which some are bold. A line that is too long is set smaller, and cut if
/// it is still too long.
fn boxed(
    page: &mut Page,
    center: Point,
    size: [f64; 2],
    fill: &str,
    lines: &[String],
    is_bold: fn(usize) -> bool,
) {
    let corner = [center[0] - size[0] / 2.0, center[1] - size[1] / 2.0];
    page.rectangle(corner, size, 2.0, fill, Some(Stroke::new(GRAY, 0.6)));
    let (leading, room) = (7.6, size[0] - 1.5);
    for (index, line) in lines.iter().enumerate() {
        let y = center[1] + 2.2 + leading * (index as f64 - (lines.len() as f64 - 1.0) / 2.0);
        let mut style = Type { face: if is_bold(index) { Face::Bold } else { Face::Regular }, ..Type::SMALL };
        style.size = (style.size * room / style.width(line)).clamp(SMALLEST, style.size);
        let (mut kept, mut shown) = (line.clone(), line.clone());
        while style.width(&shown) > room && kept.pop().is_some() {
            shown = format!("{kept}…");
        }
        page.text(&shown, [center[0], y], style);
    }
}

/// Size of the smallest letters, points.
const SMALLEST: f64 = 5.5;

/// A modality's name for people, and its shape.
fn modality_lines(modality: &Definition) -> [String; 2] {
    let shape = match modality.size() {
        Some([rows, columns]) => format!("{rows} × {columns} × {IMAGE_CHANNELS}"),
        None => modality.width().to_string(),
    };
    [modality.name.name().replace('_', " "), shape]
}

/// Height of a block with two lines, points.
const TWO: f64 = 20.0;
/// Height of a block with three lines, points.
const THREE: f64 = 27.5;
/// Width of blocks in the column for frames, points.
const WIDE: f64 = 62.0;
/// Width of blocks in the column for vectors, which is beside the column for frames, points.
const NARROW: f64 = 50.0;
/// Distance between the columns, and between blocks of a row, points.
const BETWEEN: f64 = 4.0;
/// Width beside a row of blocks for an arrow that passes it, points.
const PASSING: f64 = 8.0;
/// Distance from one row of blocks to the next, points.
const STEP: f64 = 36.0;
const COLUMN_WIDTH: f64 = WIDE + BETWEEN + NARROW;

/// Draws a network from `top` on, and a remark below it. `above` draws what is above the network. Data flow downwards
/// through the encoder at the left, and upwards through the decoder at the right.
pub fn network(
    title: &str,
    top: f64,
    anatomy: &Anatomy,
    remark: &str,
    above: impl FnOnce(&mut Page),
) -> Page {
    let frozen = anatomy.task == Task::Reconstruction;
    let (encoder, decoder) = (Part::encoder(anatomy), Part::decoder(anatomy));
    let (left, right) = (2.0, COLUMN - 2.0 - COLUMN_WIDTH);
    let rows = encoder.blocks().iter().chain(&decoder.blocks()).map(|block| block.depth).max().unwrap_or(0);
    let tallest = tallest(&anatomy.input).max(tallest(&anatomy.output));
    let first = top + 13.0 + tallest - TWO / 2.0;
    let y = |depth: usize| first + (rows + 1 - depth) as f64 * STEP;
    let bottom = y(0) + THREE / 2.0;
    let mut page = Page::new(COLUMN, bottom + 15.25, title);
    above(&mut page);
    let mut heading = |left: f64, text: &str| {
        page.text(text, [left + COLUMN_WIDTH / 2.0, top + 7.0], Type { face: Face::Italic, ..Type::LABEL });
    };
    let encoder_heading = match (frozen, anatomy.has_memory()) {
        (false, false) => "fusion encoder *f*",
        (false, true) => "fusion encoder *f* with memory",
        (true, false) => "fusion encoder *f*, trained before, frozen",
        (true, true) => "encoder *f* with memory, frozen",
    };
    heading(left, encoder_heading);
    heading(right, if frozen { "reconstruction decoder *r*" } else { "predictive decoder *p*" });
    part(&mut page, &encoder, left, first, y, if frozen { FROZEN } else { WHITE });
    part(&mut page, &decoder, right, first, y, WHITE);
    latent(&mut page, [&encoder, &decoder], [left, right], y(0), anatomy);
    axes::remark(&mut page, remark, [COLUMN / 2.0, bottom + 9.0]);
    page
}

/// Horizontal center and width of the blocks in a column of a part whose left edge is at `left`.
fn column(left: f64, lane: Lane) -> (f64, f64) {
    match lane {
        Lane::Images => (left + WIDE / 2.0, WIDE),
        Lane::Vectors => (left + WIDE + BETWEEN + NARROW / 2.0, NARROW),
        Lane::Both => (left + COLUMN_WIDTH / 2.0, COLUMN_WIDTH),
    }
}

/// Horizontal center and width of a block of a part whose left edge is at `left`.
fn place(left: f64, block: &Block) -> (f64, f64) {
    let (x, width) = column(left, block.lane);
    let ([index, count], room) = (block.position, width - PASSING * block.passing as f64);
    let own = (room - BETWEEN * (count as f64 - 1.0)) / count as f64;
    (x - width / 2.0 + index as f64 * (own + BETWEEN) + own / 2.0, own)
}

/// Horizontal places of the ends of an arrow between two blocks with these centers and widths: the same place if one
/// block is above the other.
fn ends(near: (f64, f64), far: (f64, f64)) -> [f64; 2] {
    let edges = |(x, width): (f64, f64)| [x - width / 2.0, x + width / 2.0];
    let (start, end) = (edges(near)[0].max(edges(far)[0]), edges(near)[1].min(edges(far)[1]));
    if end > start {
        return [(start + end) / 2.0; 2];
    }
    let side = (far.0 - near.0).signum();
    [near.0 + side * near.1 / 4.0, far.0 - side * far.1 / 4.0]
}

/// Draws a part: its modalities in the row at `first`, its layers below, and the arrows between them. `y` is the center
/// of the row of layers with a depth.
fn part(page: &mut Page, part: &Part, left: f64, first: f64, y: impl Fn(usize) -> f64, fill: &str) {
    let blocks = part.blocks();
    let height = |block: &Block| if block.lines.len() > 2 { THREE } else { TWO };
    for block in &blocks {
        let (x, width) = place(left, block);
        self::block(page, [x, y(block.depth)], [width, height(block)], fill, &block.lines);
    }
    for (end, is_image) in [(IMAGES, true), (VECTORS, false)] {
        let (x, width) = column(left, part.lane(end));
        stack(
            page,
            [x, first],
            width,
            part.modalities.iter().filter(|modality| modality.is_image() == is_image),
        );
    }
    let named = |name: &str| blocks.iter().find(|block| block.name == name);
    for (near, far) in &part.pairs {
        let Some(near) = named(near) else { continue };
        let far_block = named(far);
        let far_place = far_block.map_or_else(|| column(left, part.lane(far)), |far| place(left, far));
        let lane = part.lane_of(&(near.name, far));
        let passing = part.passing(lane).iter().position(|pair| *pair == (near.name, *far));
        let [near_x, far_x] = match passing {
            Some(index) => {
                let (x, width) = column(left, lane);
                [x + width / 2.0 - PASSING * (index as f64 + 0.5); 2]
            }
            None => ends(place(left, near), far_place),
        };
        let low = y(near.depth) - height(near) / 2.0;
        let high = far_block.map_or(first + TWO / 2.0, |far| y(far.depth) + height(far) / 2.0);
        let (from, to, layer) = if part.is_encoder() {
            ([far_x, high], [near_x, low], far_block)
        } else {
            ([near_x, low], [far_x, high], Some(near))
        };
        let middle = (from[1] + to[1]) / 2.0;
        let bends: &[Point] = if near_x == far_x { &[] } else { &[[from[0], middle], [to[0], middle]] };
        page.arrow(&[&[from], bends, &[to]].concat(), LINE);
        if layer.is_some_and(|layer| layer.relu_beside) {
            let middle = from[1] + (to[1] - from[1]).clamp(-NEAR, NEAR) / 2.0;
            beside(page, "ReLU", [from[0], middle]);
        }
    }
}

/// Writes a remark beside a vertical arrow.
fn beside(page: &mut Page, remark: &str, [x, y]: Point) {
    let style = Type { size: 5.6, ..Type::SMALL.start().color(GRAY) };
    page.text(remark, [x + 3.0, y + 1.375], style);
}

/// A remark beside a longer arrow is beside so much of its beginning, points.
const NEAR: f64 = STEP - (TWO + THREE) / 2.0;

/// Draws the latent state between encoder and decoder, and for predictions the action beside it.
fn latent(page: &mut Page, [from, to]: [&Part; 2], [left, right]: [f64; 2], y: f64, anatomy: &Anatomy) {
    let (encoder, decoder) = (column(left, Lane::Both).0, column(right, Lane::Both).0);
    let acting = anatomy.action > 0;
    let how = if acting { "sampled: *μ* + *σε*" } else { "the mean *μ*" };
    let size = [62.0, THREE];
    let center = [if acting { encoder + 46.0 } else { (encoder + decoder) / 2.0 }, y];
    let lines = ["latent state *z*".to_owned(), anatomy.latent_words(), how.to_owned()];
    block(page, center, size, LATENT, &lines);
    let above = y - STEP + TWO / 2.0;
    for end in from.blocks() {
        let (x, _) = place(left, &end);
        if end.name == POSTERIOR {
            page.arrow(&[[x, above], [x, y], [center[0] - size[0] / 2.0, y]], LINE);
        } else if end.name == PRIOR {
            let edge = y - size[1] / 2.0;
            page.arrow(&[[x, above], [x, edge]], LINE);
            beside(page, "not seen", [x, (above + edge) / 2.0]);
        }
    }
    for (_, layer) in to.pairs.iter().filter(|(near, _)| *near == description::LATENT) {
        let enter = column(right, to.lane(layer)).0 - if acting { 32.0 } else { 0.0 };
        page.arrow(&[[center[0] + size[0] / 2.0, y], [enter, y], [enter, above]], LINE);
    }
    if acting {
        let place = [decoder + 24.0, y];
        let lines = ["action *a*_{t}".to_owned(), anatomy.action.to_string()];
        block(page, place, [60.0, TWO], ACTION, &lines);
        page.arrow(&[[place[0], y - TWO / 2.0], [place[0], above]], LINE);
    }
}

/// Height of the taller one of the two stacks of `modalities`, frames and vectors, in points.
fn tallest(modalities: &[Definition]) -> f64 {
    let frames = modalities.iter().filter(|modality| modality.is_image()).count();
    stack_height(frames.max(modalities.len() - frames))
}

fn stack_height(count: usize) -> f64 {
    if count > 1 { count as f64 * 15.5 + 4.0 } else { TWO }
}

/// Draws one block with the names of all `modalities`, if there are any. Its lower edge is that of a block with two
/// lines at the point.
fn stack<'a>(page: &mut Page, [x, y]: Point, width: f64, modalities: impl Iterator<Item = &'a Definition>) {
    let lines: Vec<String> = modalities.flat_map(modality_lines).collect();
    if !lines.is_empty() {
        let height = stack_height(lines.len() / 2);
        boxed(page, [x, y - (height - TWO) / 2.0], [width, height], INPUT, &lines, |index| index % 2 == 0);
    }
}
