//! Figure of the confusion of categories: which part of the samples of each category is predicted as each.

use super::axes::remarks;
use super::page::{BLACK, BLUE, COLUMN, Page, Stroke, Type, WHITE};
use super::plot::plain;
use super::source::{Runs, reals, texts};
use super::{Drawing, FigureError};
use harness_shared::numbers::counted;
use harness_spec::Definition;

/// Largest side of a cell, points.
const SIDE: f64 = 24.0;
/// Space above the cells, and beside the names of categories, points.
const TOP: f64 = 16.0;
const AXIS: f64 = 16.0;
/// Largest length and height of a name, points.
const LONGEST: f64 = 60.0;
const LINE: f64 = 7.0;
/// The most categories whose cells have numbers.
const MOST_NUMBERS: usize = 12;

/// Draws the confusion of this modality, or of the first one with categories that the runs predict. The samples of all
/// runs count together.
///
/// # Errors
/// When the runs predict no such modality, or a table can't be read.
pub fn render_of(runs: &Runs, modality: Option<&str>) -> Result<Drawing, FigureError> {
    let mut outputs = runs.all[0].record.spec.output.iter().filter_map(|name| runs.layout().get(*name));
    let is_wanted = |own: &&Definition| own.category && modality.is_none_or(|name| own.name.name() == name);
    let definition = outputs.find(is_wanted).ok_or_else(|| runs.no_rows())?;
    let data = runs.query(&format!(
        "select split_part(direction, ' as ', 1) as category, split_part(direction, ' as ', 2) as predicted, \
         sum(value) as samples from metrics where metric = 'confusion' and model = 'network' \
         and task = 'prediction' and modality = '{}' group by category, predicted order by category, predicted",
        definition.name
    ))?;
    let names: Vec<&str> = definition.elements().iter().map(|element| element.name.as_str()).collect();
    let place = |name: &String| names.iter().position(|own| own == name);
    let mut counts = vec![vec![0.0; names.len()]; names.len()];
    let pairs = texts(&data, "category")?.into_iter().zip(texts(&data, "predicted")?);
    for ((category, predicted), samples) in pairs.zip(reals(&data, "samples")?) {
        if let (Some(row), Some(column)) = (place(&category), place(&predicted)) {
            counts[row][column] += samples.unwrap_or_default();
        }
    }
    let title = format!("Confusion of {}", definition.name.name().replace('_', " "));
    let of = counted(runs.all.len(), "run");
    Ok(Drawing { page: draw(&title, &names, &counts, &of), data })
}

fn draw(title: &str, names: &[&str], counts: &[Vec<f64>], runs: &str) -> Page {
    let words: Vec<String> = names.iter().map(|name| fitted(name)).collect();
    let room = words.iter().map(|word| Type::SMALL.width(word)).fold(0.0, f64::max) + AXIS;
    let side = ((COLUMN - room - 4.0) / names.len() as f64).min(SIDE);
    let all = side * names.len() as f64;
    let [left, bottom] = [(COLUMN + room - all) / 2.0, TOP + all];
    let mut page = Page::new(COLUMN, bottom + room + 12.0, title);
    page.text(&plain(title), [left, 9.0], Type::BOLD.start());
    for (row, counts) in counts.iter().enumerate() {
        let sum: f64 = counts.iter().sum();
        for (column, count) in counts.iter().enumerate().filter(|(_, count)| **count > 0.0) {
            let ([x, y], share) = ([left + side * column as f64, TOP + side * row as f64], count / sum);
            page.area(&[[x, y], [x + side, y], [x + side, y + side], [x, y + side]], BLUE, share);
            if names.len() <= MOST_NUMBERS {
                let color = if share > 0.5 { WHITE } else { BLACK };
                let at = [x + side / 2.0, y + side / 2.0 + 2.2];
                page.text(&format!("{:.0}", 100.0 * share), at, Type::SMALL.color(color));
            }
        }
    }
    for end in [0.0, all] {
        page.line([left + end, TOP], [left + end, bottom], Stroke::new(BLACK, 0.6));
        page.line([left, TOP + end], [left + all, TOP + end], Stroke::new(BLACK, 0.6));
    }
    // Of many categories, there is room for the name of every k-th.
    let every = (LINE / side).ceil() as usize;
    for (index, word) in words.iter().enumerate().step_by(every.max(1)) {
        let middle = side * (index as f64 + 0.5) + 2.2;
        page.text(word, [left - 3.0, TOP + middle], Type::SMALL.end());
        page.text(word, [left + middle, bottom + 3.0], Type::SMALL.end().upright());
    }
    page.text("category", [left - room + 8.0, TOP + all / 2.0], Type::LABEL.upright());
    page.text("predicted", [left + all / 2.0, bottom + room - 4.0], Type::LABEL);
    remarks(&mut page, bottom + room + 6.0, [format!("% of the samples of a category; {runs}")]);
    page
}

/// A name, shortened to the space for names.
fn fitted(name: &str) -> String {
    let name = plain(&name.replace('_', " "));
    let fits = |name: &str| Type::SMALL.width(name) <= LONGEST;
    if fits(&name) {
        return name;
    }
    let ends = name.char_indices().map(|(end, _)| format!("{}…", &name[..end]));
    ends.rev().find(|short| fits(short)).unwrap_or_default()
}
