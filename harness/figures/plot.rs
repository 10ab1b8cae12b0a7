//! A plot of a metric over a setting, for any runs: one series for each value of other settings, in one or several
//! panels.

use super::axes::{Line, Look, Panel, Scale, legend, remarks};
use super::page::{BLACK, BLUE, COLUMN, GRAY, GREEN, Mark, PALE, Page, Stroke, Type, VERMILION, WINE};
use super::{Drawing, FigureError};
use harness_analysis::models::{NETWORK, PERSISTENCE, is_baseline};
use harness_analysis::{Answer, Interval, Key, Label, Labels, Mean, Of, Over, Question, replicates_of};
use harness_metrics::{Metric, label};
use harness_registry::Registry;
use harness_shared::numbers::rounded;
use harness_spec::Task;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

/// Height of a panel, points.
const HEIGHT: f64 = 110.0;
/// Space below a panel for names, the axis label and the heading of the next panel, points.
const BELOW: f64 = 38.0;
/// The colors of the series of networks. The second half has hollow points.
const COLORS: [&str; 6] = [BLUE, VERMILION, GREEN, WINE, BLACK, GRAY];
/// The points of networks, by turns.
const MARKS: [Mark; 2] = [Mark::Disc, Mark::Square];
/// The points of baselines, whose lines are dashed.
const BASELINE_MARKS: [Mark; 3] = [Mark::Diamond, Mark::Triangle, Mark::Cross];
/// The most series that can be told apart.
pub(super) const MOST_SERIES: usize = 2 * COLORS.len();
/// The most panels.
pub(super) const MOST_PANELS: usize = 8;
/// Height of a row of names, points.
const ROW: f64 = 8.0;
/// Part of a slot's width over which the points of its series are spread.
const SPREAD: f64 = 0.6;
/// The most values beyond the axis that the remarks name.
const MOST_NAMED: usize = 6;
/// An outlier is at least this many times as far from the other values as these are from each other.
const FAR: f64 = 9.0;

/// A plot of the answer to a question about one metric.
#[derive(Debug, Clone)]
pub struct Plot {
    /// The question. All keys of the plot tell its means apart.
    pub(super) question: Question,
    /// The key along the horizontal axis.
    pub(super) x: Key,
    /// The keys that distinguish series.
    pub(super) by: Vec<Key>,
    /// The key that distinguishes panels.
    pub(super) facet: Option<Key>,
}

/// The values of a key that occur, in order.
pub(super) type Values = Vec<Label>;

/// The networks with the same values of the keys `by`, or a baseline.
pub(super) struct Series<'a> {
    /// Its name in the legend.
    pub name: String,
    /// How it looks.
    pub look: Look,
    /// Whether it is of networks. They come before the baselines.
    pub is_network: bool,
    spots: Vec<Spot<'a>>,
}

/// A mean, and where it is drawn.
pub(super) struct Spot<'a> {
    panel: usize,
    /// Its position along the horizontal axis.
    slot: usize,
    value: &'a Interval,
}

impl Plot {
    /// A plot over the key `x`, with a panel for each value of `facet` and a series for each value of the question's
    /// keys. Without others, the models are networks, and the task is the prediction unless it is one of the keys.
    pub fn new(question: Question, x: Key, facet: Option<Key>) -> Self {
        let mut plot = Self { by: question.by.clone(), question, x, facet };
        let question = &mut plot.question;
        question.by = [x].into_iter().chain(question.by.iter().copied()).chain(facet).collect();
        if question.models.is_empty() {
            question.models.push(NETWORK.to_owned());
        }
        if !question.by.contains(&Key::Task) {
            question.task.get_or_insert(Task::Prediction);
        }
        plot
    }

    /// The plot of R² over a key, by modality, with a panel for each scenario. Beside the networks, it shows
    /// persistence alone, so that six modalities have room.
    pub(crate) fn over(x: Key, task: Task) -> Self {
        let question = Question {
            metrics: vec![Metric::R2.name().to_owned()],
            models: vec![NETWORK.to_owned(), PERSISTENCE.to_owned()],
            task: Some(task),
            by: vec![Key::Modality],
            ..Question::default()
        };
        Self::new(question, x, Some(Key::Scenario))
    }

    /// Draws the answer about the runs of a results folder, and returns its notes.
    ///
    /// # Errors
    /// When the question has no answer or several metrics, when the means differ in a key that the plot does not show,
    /// or when there are too many series or panels.
    pub fn ask(&self, registry: &Registry) -> Result<(Drawing, Vec<String>), FigureError> {
        let answer = self.question.ask(registry)?;
        Ok((self.draw(&answer)?, answer.notes))
    }

    /// Draws the answer to the plot's question.
    pub(crate) fn draw(&self, answer: &Answer) -> Result<Drawing, FigureError> {
        if answer.metrics.len() > 1 && !self.question.by.contains(&Key::Metric) {
            return Err(FigureError::SeveralMetrics(answer.metrics.clone()));
        }
        let about = answer.differences().into_iter().chain(answer.ahead()).collect();
        let Some(base) = &answer.against else {
            return self.draw_means(&answer.cells, &answer.labels, about);
        };
        // Among differences, the values of the column from which they are have no place.
        let cells: Vec<Mean> = answer.cells.iter().filter(|cell| cell.against.is_some()).cloned().collect();
        match cells.is_empty() {
            true => Err(FigureError::NoDifferences(base.name())),
            false => self.draw_means(&cells, &answer.labels, about),
        }
    }

    /// The metric along the vertical axis. It is empty if the plot tells metrics apart.
    pub(super) fn y(&self) -> &str {
        match self.question.metrics.first() {
            Some(metric) if !self.question.by.contains(&Key::Metric) => metric,
            _ => "",
        }
    }

    /// The label of the vertical axis.
    pub(super) fn label(&self, means: &[Mean]) -> String {
        let units: BTreeSet<&str> = means.iter().map(|mean| mean.unit.as_str()).collect();
        // Without a unit if the values have several.
        let unit = if units.len() == 1 { means[0].unit.as_str() } else { "1" };
        let label = match self.y() {
            "" if unit == "1" => "value".to_owned(),
            "" => unit.to_owned(),
            metric => label(metric, unit),
        };
        let is_difference = means.iter().any(|mean| mean.against.is_some());
        let label = if is_difference { format!("difference of {label}") } else { label };
        let modalities: BTreeSet<String> = means.iter().map(|mean| mean.of.predicted()).collect();
        match modalities.first() {
            Some(modality) if modalities.len() == 1 => format!("{}, {label}", modality.replace('_', " ")),
            _ => label,
        }
    }

    /// Returns an error if the means differ in a key that the plot does not show.
    pub(super) fn check(&self, means: &[Mean], labels: &Labels) -> Result<(), FigureError> {
        for key in Key::ALL.into_iter().filter(|key| !self.question.by.contains(key)) {
            let values = values(key, means, labels);
            if values.len() > 1 {
                let values: Vec<String> = values.iter().map(|value| value.text().to_owned()).collect();
                return Err(FigureError::Ambiguous { can_distinguish: true, key: key.name(), values });
            }
        }
        Ok(())
    }

    /// The series of all means: first those of the networks, then those of each baseline. The series of a baseline with
    /// the same points are one.
    pub(super) fn series<'a>(
        &self,
        means: &'a [Mean],
        panels: &Values,
        slots: &Values,
        labels: &Labels,
    ) -> Vec<Series<'a>> {
        let panels_of = |of: &Of| self.facet.map_or(0..1, |key| places(key, of, panels, labels));
        let spots_of = |mean: &'a Mean| {
            let across = move || places(self.x, &mean.of, slots, labels);
            let spots = |panel| across().map(move |slot| Spot { panel, slot, value: &mean.interval });
            panels_of(&mean.of).flat_map(spots).collect::<Vec<_>>()
        };
        let mut networks: BTreeMap<Values, Vec<Spot>> = BTreeMap::new();
        let mut baselines: BTreeMap<(&str, Values), Vec<Spot>> = BTreeMap::new();
        for mean in means {
            let keys = self.by.iter().filter(|key| !is_every_value(**key, &mean.of));
            let by: Values = keys.map(|key| value(*key, &mean.of, labels)).collect();
            let spots = if !mean.of.is_baseline() {
                networks.entry(by).or_default()
            } else {
                baselines.entry((&mean.of.model, by)).or_default()
            };
            spots.extend(spots_of(mean));
        }
        let own: Vec<Values> = networks.keys().cloned().collect();
        let network = |(place, (by, spots)): (usize, (Values, Vec<Spot<'a>>))| {
            let name = if by.is_empty() { one_model(means).to_owned() } else { words(&by) };
            Series { name, look: look(place), is_network: true, spots }
        };
        let mut series: Vec<Series> = networks.into_iter().enumerate().map(network).collect();
        let order = |model: &str| {
            self.question.models.iter().filter(|name| is_baseline(name)).position(|name| name == model)
        };
        let mut baselines = merged(baselines);
        baselines.sort_by_key(|(model, by, _)| (order(model), by.clone()));
        for (model, by, spots) in baselines {
            let mark = order(model);
            let place = own.iter().position(|values| !by.is_empty() && *values == by);
            let color = place.map_or(BLACK, |place| look(place).color);
            let mark = BASELINE_MARKS[mark.unwrap_or_default() % BASELINE_MARKS.len()];
            let model = model.replace('_', " ");
            let name = if by.is_empty() { model } else { format!("{}, {model}", words(&by)) };
            let look = Look { color, mark, hollow: true, line: Line::Dashed };
            series.push(Series { name, look, is_network: false, spots });
        }
        if !self.is_ordered(slots) {
            series.iter_mut().for_each(|one| one.look.line = Line::None);
        }
        series
    }

    /// Whether there is something between the values along the horizontal axis, so that a line through the points has a
    /// meaning: they are numbers, and not categories.
    fn is_ordered(&self, slots: &Values) -> bool {
        match self.x {
            Key::Latent | Key::Horizon => true,
            Key::Setting(_) => slots.iter().all(|value| value.text().parse::<f64>().is_ok()),
            _ => false,
        }
    }

    fn draw_means(
        &self,
        means: &[Mean],
        labels: &Labels,
        about: Vec<String>,
    ) -> Result<Drawing, FigureError> {
        self.check(means, labels)?;
        let label = self.label(means);
        let panels = self.facet.map_or(vec![Label::from(String::new())], |key| values(key, means, labels));
        let slots = values(self.x, means, labels);
        let all = self.series(means, &panels, &slots, labels);
        if all.len() > MOST_SERIES || panels.len() > MOST_PANELS {
            return Err(FigureError::TooMany { series: all.len(), panels: panels.len() });
        }
        let entries: Vec<(Look, &str)> = all.iter().map(|one| (one.look, one.name.as_str())).collect();
        let legends = if entries.len() > 1 || !self.by.is_empty() { rows_of(&entries) } else { Vec::new() };
        let [low, high] = range(means);
        let axis = |ends: [f64; 2]| Scale::linear(low, high, 5, ends);
        let notes = notes(means, &self.beyond(&all, &panels, &slots, &axis([0.0, 1.0])), &axis([0.0, 1.0]));
        let notes: Vec<String> = about.into_iter().chain(notes).collect();

        let columns = panels.len().min(2);
        let left = 36.0;
        let between = 12.0;
        let width = (COLUMN - left - 4.0 - between * (columns as f64 - 1.0)) / columns as f64;
        let names: Vec<String> = slots.iter().map(|value| plain(value.text())).collect();
        let way = NamesWay::of(&names, width);
        let below = BELOW + way.extra(&names);
        let top = 8.0 + 9.0 * legends.len() as f64 + if self.facet.is_some() { 12.0 } else { 4.0 };
        let rows = panels.len().div_ceil(columns);
        let bottom = top + rows as f64 * (HEIGHT + below);
        let height = bottom + 4.0 + 8.5 * (notes.len() as f64 - 1.0);

        let mut page = Page::new(COLUMN, height, &format!("{label} over {}", name_of(self.x)));
        for (row, entries) in legends.iter().enumerate() {
            legend(&mut page, COLUMN / 2.0, 9.0 + 9.0 * row as f64, entries);
        }
        for (place, panel_value) in panels.iter().enumerate() {
            let (row, column) = (place / columns, place % columns);
            let panel = Panel {
                left: left + column as f64 * (width + between),
                top: top + row as f64 * (HEIGHT + below),
                width,
                height: HEIGHT,
            };
            let scale = axis(panel.upwards());
            panel.left_axis(&mut page, &scale, (column == 0).then_some(label.as_str()));
            if self.facet.is_some() {
                let letter = char::from(b'a' + place as u8).to_string();
                panel.heading(&mut page, &letter, &plain(panel_value.text()));
            }
            let centers = panel.slots(slots.len());
            self.name(&mut page, &panel, &centers, &names, way);
            let slot = width / slots.len() as f64;
            if all.len() > 1 {
                for center in &centers[1..] {
                    let x = center - slot / 2.0;
                    page.line([x, panel.top], [x, panel.bottom()], Stroke::new(PALE, 0.5));
                }
            }
            let across = |order: usize, place: usize| {
                let aside = order as f64 - (all.len() as f64 - 1.0) / 2.0;
                centers[place] + aside * SPREAD * slot / all.len() as f64
            };
            draw(&mut page, &all, place, &scale, across);
        }
        remarks(&mut page, bottom, notes);
        Ok(Drawing { page, data: Mean::frame(means)? })
    }

    /// The means beyond the axis, in words. A baseline that is at every latent size is named once.
    pub(super) fn beyond(
        &self,
        all: &[Series],
        panels: &Values,
        slots: &Values,
        scale: &Scale,
    ) -> Vec<String> {
        let mut named = Vec::new();
        for series in all {
            for spot in series.spots.iter().filter(|spot| scale.clamp(spot.value.mean) != spot.value.mean) {
                let mut here = series.spots.iter().filter(|other| other.panel == spot.panel);
                let varies = slots.len() > 1 && here.any(|other| other.value.mean != spot.value.mean);
                let panel = match panels.len() {
                    1 => String::new(),
                    _ => format!(", {}", panels[spot.panel].text()),
                };
                let slot = if varies { format!(" at {}", slots[spot.slot].text()) } else { String::new() };
                let place = plain(&format!("{}{panel}{slot}", series.name));
                named.push(format!("{place}: {}", rounded(spot.value.mean).replace('-', "\u{2212}")));
            }
        }
        named.dedup();
        named
    }

    /// Writes the names along the horizontal axis.
    fn name(&self, page: &mut Page, panel: &Panel, slots: &[f64], names: &[String], way: NamesWay) {
        panel.bottom_ticks(page, slots);
        for (place, (x, name)) in slots.iter().zip(names).enumerate() {
            match way {
                NamesWay::Rows(rows) => {
                    let middle = panel.left + middle(name, x - panel.left, panel.width);
                    let y = panel.bottom() + 8.7 + ROW * (place % rows) as f64;
                    page.text(name, [middle, y], Type::SMALL);
                }
                NamesWay::Upright => {
                    page.text(name, [x + 2.2, panel.bottom() + 4.0], Type::SMALL.upright().end());
                }
            }
        }
        let y = panel.bottom() + 17.7 + way.extra(names);
        page.text(name_of(self.x), [panel.left + panel.width / 2.0, y], Type::LABEL);
    }
}

/// Draws the points of all series in the panel at `place`, and the lines between them. `across` returns the horizontal
/// position, in points, for the number of a series and a slot.
pub(super) fn draw(
    page: &mut Page,
    all: &[Series],
    place: usize,
    scale: &Scale,
    across: impl Fn(usize, usize) -> f64,
) {
    for (order, series) in all.iter().enumerate() {
        let here = series.spots.iter().filter(|spot| spot.panel == place);
        let mut points: Vec<(f64, &Interval)> =
            here.map(|spot| (across(order, spot.slot), spot.value)).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let within = points.iter().filter(|(_, value)| scale.clamp(value.mean) == value.mean);
        let path: Vec<_> = within.map(|(x, value)| [*x, scale.at(value.mean)]).collect();
        series.look.path(page, &path);
        for (x, value) in points {
            point(page, series.look, x, scale, value);
        }
    }
}

/// A mean's value of a key.
fn value(key: Key, of: &Of, labels: &Labels) -> Label {
    let text = match key {
        Key::Latent => of.latent.unwrap_or_default().to_string(),
        Key::Experiment => of.experiment.clone(),
        Key::Scenario => of.scenario.name().to_owned(),
        Key::Variant => return labels.variant(&of.variant).or(NETWORK),
        Key::Setting(key) => return labels.value(key, of.values.get(key).map_or("", String::as_str)),
        Key::Settings => of.settings.clone(),
        Key::Horizon => of.horizon.map_or_else(String::new, |horizon| horizon.to_string()),
        Key::Given => return labels.given(of.given.as_deref()),
        Key::Task => of.task.name().to_owned(),
        Key::Modality => of.predicted(),
        Key::Metric => of.metric.clone(),
    };
    Label::from(if text.is_empty() { "none".into() } else { text })
}

/// The values of a key that occur. A baseline has none of the latent size, and a reconstruction none of the horizon.
pub(super) fn values(key: Key, means: &[Mean], labels: &Labels) -> Values {
    let own = means.iter().filter(|mean| !is_every_value(key, &mean.of));
    let found: BTreeSet<Label> = own.map(|mean| value(key, &mean.of, labels)).collect();
    if found.is_empty() { vec![Label::from("none".to_owned())] } else { found.into_iter().collect() }
}

/// The name of a key along an axis.
fn name_of(key: Key) -> &'static str {
    if key == Key::Horizon { "horizon (samples)" } else { key.name() }
}

/// Whether a mean belongs to every value of a key, as a baseline belongs to every latent size.
fn is_every_value(key: Key, of: &Of) -> bool {
    match key {
        Key::Latent => of.latent.is_none(),
        Key::Given => of.is_baseline(),
        Key::Horizon => of.horizon.is_none() || of.task == Task::Reconstruction,
        _ => false,
    }
}

/// The positions of a mean among the values of a key.
fn places(key: Key, of: &Of, values: &Values, labels: &Labels) -> Range<usize> {
    if is_every_value(key, of) {
        return 0..values.len();
    }
    let own = value(key, of, labels);
    let place = values.iter().position(|value| *value == own).unwrap_or_default();
    place..place + 1
}

/// The points of a series by panel and slot, each with its text.
type Points<'a> = BTreeMap<(usize, usize), BTreeMap<String, Spot<'a>>>;

/// Makes one series of the series of a baseline that agree, up to rounding, wherever both have points. It keeps the
/// values that they share, or the first ones if another series of this baseline shares the same.
fn merged<'a, 'b>(
    baselines: BTreeMap<(&'b str, Values), Vec<Spot<'a>>>,
) -> Vec<(&'b str, Values, Vec<Spot<'a>>)> {
    struct Alike<'a, 'b> {
        model: &'b str,
        shared: Values,
        first: Values,
        points: Points<'a>,
    }
    let mut all: Vec<Alike> = Vec::new();
    for ((model, by), spots) in baselines {
        let mut points = Points::new();
        for spot in spots {
            let ends = [spot.value.mean, spot.value.low(), spot.value.high()];
            let text = ends.map(|end| format!("{end:.4e}")).join(" ");
            points.entry((spot.panel, spot.slot)).or_default().insert(text, spot);
        }
        match all.iter_mut().find(|other| other.model == model && agree(&other.points, &points)) {
            Some(alike) => {
                alike.shared.retain(|value| by.contains(value));
                for (place, found) in points {
                    alike.points.entry(place).or_insert(found);
                }
            }
            None => all.push(Alike { model, shared: by.clone(), first: by, points }),
        }
    }
    let shared: Vec<(&str, Values)> = all.iter().map(|alike| (alike.model, alike.shared.clone())).collect();
    let is_unique = |model: &str, by: &Values| {
        shared.iter().filter(|(other, values)| *other == model && values == by).count() == 1
    };
    let named = |Alike { model, shared, first, points }: Alike<'a, 'b>| {
        let by = if is_unique(model, &shared) { shared } else { first };
        (model, by, points.into_values().flat_map(BTreeMap::into_values).collect())
    };
    all.into_iter().map(named).collect()
}

/// Whether two series have a place in common, and the same points at each place that both have.
fn agree(a: &Points, b: &Points) -> bool {
    let mut common = a.iter().filter_map(|(place, found)| Some((found, b.get(place)?))).peekable();
    common.peek().is_some() && common.all(|(a, b)| a.keys().eq(b.keys()))
}

/// Draws a point, or an arrow at the end of the axis if it lies beyond.
fn point(page: &mut Page, look: Look, x: f64, scale: &Scale, value: &Interval) {
    let end = scale.clamp(value.mean);
    if end == value.mean {
        return look.point(page, x, scale, value);
    }
    let inwards = if value.mean < end { -9.0 } else { 9.0 };
    let y = scale.at(end);
    page.arrow(&[[x, y + inwards], [x, y]], Stroke::new(look.color, 0.8));
}

/// The look of a series of networks.
fn look(place: usize) -> Look {
    let is_second = place >= COLORS.len();
    Look {
        color: COLORS[place % COLORS.len()],
        mark: MARKS[place % MARKS.len()],
        hollow: is_second,
        line: if is_second { Line::Dashed } else { Line::Solid },
    }
}

/// The name of the models that are no baselines, if it is one; otherwise [`NETWORK`].
fn one_model(means: &[Mean]) -> &str {
    let mut names = means.iter().filter(|mean| !mean.of.is_baseline()).map(|mean| mean.of.model.as_str());
    let first = names.next().unwrap_or(NETWORK);
    if names.all(|name| name == first) { first } else { NETWORK }
}

/// The name of a series.
fn words(values: &[Label]) -> String {
    plain(&values.iter().map(Label::text).collect::<Vec<_>>().join(", "))
}

/// A text without the characters that a page reads as markup.
pub(super) fn plain(text: &str) -> String {
    text.replace(['*', '{', '}', '^'], "")
}

/// Divides the entries of a legend into rows that fit the page.
pub(super) fn rows_of<'a>(entries: &[(Look, &'a str)]) -> Vec<Vec<(Look, &'a str)>> {
    let mut rows: Vec<Vec<(Look, &str)>> = Vec::new();
    let mut taken = f64::INFINITY;
    for entry in entries {
        let width = 27.0 + Type::SMALL.width(entry.1);
        if taken + width > COLUMN - 8.0 {
            rows.push(Vec::new());
            taken = 0.0;
        }
        taken += width;
        if let Some(row) = rows.last_mut() {
            row.push(*entry);
        }
    }
    rows
}

/// Where the middle of a name is along a panel of this width, so that the panel contains the name. Below a point at
/// `center`, if it does. In points.
fn middle(name: &str, center: f64, width: f64) -> f64 {
    let half = (Type::SMALL.width(name) / 2.0).min(width / 2.0);
    center.clamp(half, width - half)
}

/// How names are written along a horizontal axis, so that they do not overlap.
#[derive(Clone, Copy, PartialEq)]
enum NamesWay {
    /// In so many rows, one after the other.
    Rows(usize),
    /// Each reads upwards, because there would be too many rows, or a name is wider than the panel.
    Upright,
}

impl NamesWay {
    /// The way for a panel of this width in points.
    fn of(names: &[String], width: f64) -> Self {
        let slot = width / names.len() as f64;
        let fit = |rows: usize| {
            let ends = |place: usize| {
                let half = Type::SMALL.width(&names[place]) / 2.0;
                let middle = middle(&names[place], (place as f64 + 0.5) * slot, width);
                [middle - half, middle + half]
            };
            let is_within = |place: usize| ends(place)[1] - ends(place)[0] <= width;
            let are_apart = |place: usize| ends(place)[1] + 3.0 <= ends(place + rows)[0];
            (0..names.len()).all(is_within) && (0..names.len().saturating_sub(rows)).all(are_apart)
        };
        (1..=names.len().min(4)).find(|rows| fit(*rows)).map_or(Self::Upright, Self::Rows)
    }

    /// The height that the names take besides that of one row, points.
    fn extra(self, names: &[String]) -> f64 {
        match self {
            Self::Rows(rows) => ROW * (rows as f64 - 1.0),
            Self::Upright => names.iter().map(|name| Type::SMALL.width(name)).fold(0.0, f64::max) + 4.0 - ROW,
        }
    }
}

/// The range of the vertical axis. It includes the mean of every network but outliers. An interval or a baseline may be
/// cut if it is farther from these means than twice their range.
pub(super) fn range(means: &[Mean]) -> [f64; 2] {
    let networks: Vec<&Mean> = means.iter().filter(|mean| !mean.of.is_baseline()).collect();
    let chosen = if networks.is_empty() { means.iter().collect() } else { networks };
    let [low, high] = without_outliers(&chosen);
    let is_within = |mean: &&&Mean| (low..=high).contains(&mean.interval.mean);
    let shortest = chosen.iter().filter(is_within).map(|mean| mean.interval.high() - mean.interval.mean);
    let room = (high - low).max(shortest.fold(f64::INFINITY, f64::min)).max(1e-9 * high.abs());
    let ends = chosen
        .iter()
        .filter(is_within)
        .flat_map(|mean| [mean.interval.low().max(low - room), mean.interval.high().min(high + room)]);
    let near = (low - room)..=(high + room);
    let others = means.iter().map(|mean| mean.interval.mean).filter(|mean| near.contains(mean));
    let all: Vec<f64> = ends.chain(others).collect();
    [all.iter().copied().fold(low, f64::min), all.into_iter().fold(high, f64::max)]
}

/// The lowest and the highest mean without outliers, which would leave a small part of the axis to all others. Outliers
/// are fewer than half of the means, and in no interval of another one.
fn without_outliers(means: &[&Mean]) -> [f64; 2] {
    let mut values: Vec<f64> = means.iter().map(|mean| mean.interval.mean).collect();
    values.sort_by(f64::total_cmp);
    let count = values.len();
    let is_covered = |low: f64, high: f64| {
        let (kept, others): (Vec<&Mean>, Vec<&Mean>) =
            means.iter().copied().partition(|mean| (low..=high).contains(&mean.interval.mean));
        let is_in = |value: f64| {
            kept.iter().any(|mean| (mean.interval.low()..=mean.interval.high()).contains(&value))
        };
        others.iter().any(|mean| is_in(mean.interval.mean))
    };
    // Intervals take room, too.
    let shortest = |low: f64, high: f64| {
        let kept = means.iter().filter(|mean| (low..=high).contains(&mean.interval.mean));
        kept.map(|mean| mean.interval.high() - mean.interval.low()).fold(f64::INFINITY, f64::min)
    };
    let gap = |end: f64, next: Option<&f64>| next.map_or(f64::INFINITY, |next| (next - end).abs());
    for kept in (count / 2 + 1..count).rev() {
        for (place, window) in values.windows(kept).enumerate() {
            let [low, high] = [window[0], window[kept - 1]];
            let before = place.checked_sub(1).and_then(|place| values.get(place));
            let nearest = gap(low, before).min(gap(high, values.get(place + kept)));
            let spread = shortest(low, high).max(high - low);
            if high > low && nearest >= FAR * spread && !is_covered(low, high) {
                return [low, high];
            }
        }
    }
    [values[0], values[count - 1]]
}

/// The remarks below a plot: what the bars are, and the means beyond the axis.
pub(super) fn notes(means: &[Mean], beyond: &[String], scale: &Scale) -> Vec<String> {
    let networks: Vec<&Mean> = means.iter().filter(|mean| !mean.of.is_baseline()).collect();
    let is_cut = means
        .iter()
        .any(|mean| scale.cuts(&mean.interval) && scale.clamp(mean.interval.mean) == mean.interval.mean);
    let cut = if is_cut { "; without a cap, they go on beyond the axis" } else { "" };
    let judged = if networks.is_empty() { means.iter().collect() } else { networks };
    let over = judged.iter().find(|mean| mean.interval.bounds.is_some()).map(|mean| mean.over);
    let bars = match (replicates_of(judged), over) {
        (Some(replicates), Some(Over::Mean)) => format!("bars: 95 % intervals over {replicates}{cut}"),
        (Some(replicates), Some(over)) => format!("bars: {}{cut}", over.described(&replicates)),
        (Some(replicates), None) => format!("means over {replicates}, no bars"),
        (None, _) => "one seed, no bars".into(),
    };
    let mut named: Vec<String> = beyond.iter().take(MOST_NAMED).cloned().collect();
    if beyond.len() > MOST_NAMED {
        named.push(format!("{} more", beyond.len() - MOST_NAMED));
    }
    let mut lines = vec![bars];
    for (place, name) in named.into_iter().enumerate() {
        let text = if place == 0 { format!("beyond the axis: {name}") } else { format!("; {name}") };
        let last = lines.len() - 1;
        if place > 0 && Type::SMALL.width(&lines[last]) + Type::SMALL.width(&text) < COLUMN - 8.0 {
            lines[last] += &text;
        } else {
            lines.push(text.trim_start_matches("; ").to_owned());
        }
    }
    lines
}
