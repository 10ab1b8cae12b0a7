//! A frame of a clip of predictions: recorded and predicted pictures, and the elements of a vector as bars.

use super::FigureError;
use super::axes::{Panel, Scale, color_legend};
use super::page::{BLUE, COLUMN, GRAY, Page, Stroke, Type, VERMILION};
use image::RgbImage;

/// Pixels per point of a frame, which is 964 pixels wide.
const SCALE: f32 = 4.0;
/// Space around the pictures and the panel, points.
const GAP: f64 = 6.0;
const LEFT: f64 = 34.0;
/// Heights of the title, and of the name of a picture, points.
const TITLE: f64 = 16.0;
const NAME: f64 = 10.0;
/// Height of the panel of bars, points.
const HEIGHT: f64 = 84.0;
/// Part of an element's slot that its two bars fill.
const FILLED: f64 = 0.76;
/// The part of the largest force up to which the axis of forces is linear.
const LINEAR: f64 = 0.01;
/// The most names of elements that fit below the bars.
const MOST_NAMES: usize = 24;

/// What a frame shows. All frames of a clip have the same pictures and elements.
pub struct Moment {
    /// What and when it is.
    pub title: String,
    /// Rows of one or two pictures with their titles.
    pub pictures: Vec<Vec<(String, RgbImage)>>,
    /// The elements of a vector; `None` if there is none to show.
    pub bars: Option<Bars>,
}

/// Recorded and predicted elements of a vector.
pub struct Bars {
    /// The vector, with its unit.
    pub label: String,
    /// Pairs of a recorded and a predicted value.
    pub values: Vec<[f64; 2]>,
    /// The least and the largest value of the whole clip.
    pub range: [f64; 2],
    /// Whether values differ by orders of magnitude, as forces do. The axis is then linear only around 0.
    pub is_force: bool,
}

impl Moment {
    /// Draws the frame.
    ///
    /// # Errors
    /// When a picture can't be encoded.
    pub fn draw(&self) -> Result<RgbImage, FigureError> {
        let width = (COLUMN - 3.0 * GAP) / 2.0;
        let tallest = |row: &Vec<(String, RgbImage)>| {
            let shapes = row
                .iter()
                .map(|(_, picture)| f64::from(picture.height()) / f64::from(picture.width().max(1)));
            width * shapes.fold(0.0, f64::max)
        };
        let heights: Vec<f64> = self.pictures.iter().map(tallest).collect();
        let top = TITLE + heights.iter().map(|height| height + NAME + GAP).sum::<f64>();
        let height = top + if self.bars.is_some() { HEIGHT + 40.0 } else { 0.0 };
        let mut page = Page::new(COLUMN, height, &self.title);
        page.text(&self.title, [COLUMN / 2.0, 10.0], Type::LABEL);
        let mut upper = TITLE;
        for (row, height) in self.pictures.iter().zip(&heights) {
            let all = row.len() as f64 * (width + GAP) - GAP;
            for (place, (title, picture)) in row.iter().enumerate() {
                let left = (COLUMN - all) / 2.0 + place as f64 * (width + GAP);
                page.text(title, [left + width / 2.0, upper + 7.0], Type::SMALL);
                page.picture(picture, [left, upper + NAME], [width, *height], true)?;
            }
            upper += height + NAME + GAP;
        }
        if let Some(bars) = &self.bars {
            bars.draw(&mut page, top);
        }
        Page::picture_of(&page.svg(), SCALE)
    }
}

impl Bars {
    /// Draws the legend and the panel below `top`.
    fn draw(&self, page: &mut Page, top: f64) {
        color_legend(page, COLUMN / 2.0, top + 9.0, &[(BLUE, "recorded"), (VERMILION, "predicted")]);
        let panel = Panel { left: LEFT, top: top + 14.0, width: COLUMN - LEFT - GAP, height: HEIGHT };
        let [low, high] = [self.range[0].min(0.0), self.range[1].max(0.0)];
        let scale = match self.is_force && high > 0.0 {
            true => Scale::symmetric(low, high, LINEAR * high, panel.upwards()),
            false => Scale::linear(low, high, 4, panel.upwards()),
        };
        panel.left_axis(page, &scale, Some(&self.label));
        let zero = scale.at(0.0);
        let slots = panel.slots(self.values.len());
        let width = panel.width / self.values.len().max(1) as f64 * FILLED / 2.0;
        for (center, values) in slots.iter().zip(&self.values) {
            for (place, (value, color)) in values.iter().zip([BLUE, VERMILION]).enumerate() {
                let end = scale.at(scale.clamp(*value));
                let corner = [center + (place as f64 - 1.0) * width, end.min(zero)];
                page.rectangle(corner, [width, (end - zero).abs()], 0.0, color, None);
            }
        }
        page.line([panel.left, zero], [panel.right(), zero], Stroke::new(GRAY, 0.5));
        let every = self.values.len().div_ceil(MOST_NAMES).max(1);
        let name =
            |element: usize| if element.is_multiple_of(every) { element.to_string() } else { String::new() };
        panel.bottom_names(page, &slots, &(0..slots.len()).map(name).collect::<Vec<_>>(), "element");
    }
}
