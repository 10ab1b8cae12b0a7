//! Figure of contacts and contact forces: how often each link is touched, how hard, and the distribution of the force
//! over all samples. It shows the finger in both scenarios, or the links of any robot.

use super::axes::{Panel, Scale, color_legend, color_of, remarks};
use super::page::{BLUE, COLUMN, GREEN, Mark, Page, Point, Stroke, Type, VERMILION, WHITE, WINE};
use super::source::{Runs, Source, Study, dataset_seeds, integers, reals, texts};
use super::{Drawing, FigureError};
use harness_spec::{Definition, Modality, Scenario};
use polars::prelude::*;
use std::collections::BTreeMap;

const LEFT: f64 = 30.0;
const WIDTH: f64 = COLUMN - LEFT - 5.0;
const BETWEEN: f64 = 12.0;

/// Least number of samples in contact for which a link's quantiles are shown.
const FEWEST: f64 = 20.0;
/// The links in panel c, by their distance from the tip in links.
const FROM_TIP: [usize; 5] = [0, 1, 7, 12, 14];
/// Largest number of links in panel c if there is no finger. They are the ones that are touched most often.
const MOST_TOUCHED: usize = 5;
/// Largest number of scenarios of any robot.
const SCENARIOS: usize = 4;
/// The colors of the scenarios of any robot.
const COLORS: [&str; SCENARIOS] = [BLUE, VERMILION, GREEN, WINE];
/// The most letters of all names of links that fit below the panels.
const MOST_LETTERS: usize = 40;

/// For each quantile of the table, the share of the samples in contact whose force is larger.
const MORE_THAN: [f64; 5] = [0.95, 0.75, 0.5, 0.25, 0.05];

/// The query on the forces table: contacts and quantiles of the force by scenario, dataset and link.
pub const SQL: &str = "select scenario, dataset_seed, index as link, modality, 'N' as unit, \
    max(samples) as samples, max(contacts) as contacts, max(100.0 * contacts / samples) as contact_percent, \
    max(mean) as mean, max(p05) as p05, max(p25) as p25, max(p50) as p50, max(p75) as p75, max(p95) as p95, \
    max(max) as max from forces join runs using (experiment, run, scenario, latent) \
    where modality = 'contact_force' and episode is null \
    group by scenario, dataset_seed, index, modality order by scenario, link";

/// A scenario's links.
struct OfScenario {
    name: String,
    color: &'static str,
    links: Vec<Link>,
}

/// What the links are called.
struct Names {
    /// The name of each link; empty where there is no room for it.
    ticks: Vec<String>,
    /// The label of the axis of all links.
    axis: String,
    /// Whether the links are those of the finger.
    is_finger: bool,
}

/// The forces on a link in a scenario's dataset, N.
struct Link {
    index: usize,
    samples: f64,
    contacts: f64,
    /// Mean force over all samples.
    mean: f64,
    /// The force's quantiles of 5, 25, 50, 75 and 95 % over the samples in contact.
    quantiles: Option<[f64; 5]>,
    max: Option<f64>,
}

/// Draws the figure.
pub fn render(source: &Source) -> Result<Drawing, FigureError> {
    // Both studies have the same datasets, so either one's runs give the same figure.
    let runs = source
        .runs(Study::SingleToMulti)
        .or_else(|error| source.runs(Study::MultiToMulti).map_err(|_| error))?;
    let data = of_first_datasets(runs.query(SQL)?)?;
    let scenarios = Scenario::PAPER.map(|scenario| (scenario.name().to_owned(), color_of(scenario)));
    let count = runs.layout()[Modality::CONTACT_FORCE].width();
    let name = |link: usize| if link.is_multiple_of(2) { link.to_string() } else { String::new() };
    let names = Names {
        ticks: (0..count).map(name).collect(),
        axis: format!("link of the finger, 0 at the base, {} at the tip", count - 1),
        is_finger: true,
    };
    draw(data, scenarios.into(), &names, "Contacts and contact forces by link of the finger")
}

/// Draws the first force of any robot.
///
/// # Errors
/// When the runs record no contact forces, or a table can't be read.
pub fn render_of(runs: &Runs) -> Result<Drawing, FigureError> {
    let force = runs.layout().modalities.iter().find(|definition| definition.is_force());
    let force = force.ok_or_else(|| runs.no_rows())?;
    let sql = SQL.replace("modality = 'contact_force'", &format!("modality = '{}'", force.name));
    let data = of_first_datasets(runs.query(&sql)?)?;
    let mut scenarios: Vec<String> = texts(&data, "scenario")?;
    scenarios.dedup();
    let scenarios: Vec<_> = scenarios.into_iter().zip(COLORS).collect();
    let title = format!("Contacts and contact forces: {}", force.name.name().replace('_', " "));
    draw(data, scenarios, &Names::of(force), &title)
}

impl Names {
    fn of(force: &Definition) -> Self {
        let names: Vec<String> =
            force.elements().iter().map(|element| element.name.replace('_', " ")).collect();
        let what = force.name.name().replace('_', " ");
        match names.iter().map(String::len).sum::<usize>() <= MOST_LETTERS {
            true => Self { ticks: names, axis: format!("element of {what}"), is_finger: false },
            false => {
                // Of many numbers, there is room for every k-th.
                let every = names.len().div_ceil(12);
                let name =
                    |link: usize| if link.is_multiple_of(every) { link.to_string() } else { String::new() };
                let axis = format!("element of {what}, 0: {}", names[0]);
                Self { ticks: (0..names.len()).map(name).collect(), axis, is_finger: false }
            }
        }
    }
}

fn draw(
    data: DataFrame,
    scenarios: Vec<(String, &'static str)>,
    names: &Names,
    title: &str,
) -> Result<Drawing, FigureError> {
    let scenarios = by_scenario(&data, scenarios)?;
    let mut page = Page::new(COLUMN, 378.0, title);
    let entries: Vec<_> = scenarios.iter().map(|of| (of.color, of.name.as_str())).collect();
    color_legend(&mut page, COLUMN / 2.0, 9.0, &entries);
    let often = Panel { left: LEFT, top: 26.0, width: WIDTH, height: 58.0 };
    let hard = Panel { top: often.bottom() + 22.0, height: 92.0, ..often };
    how_often(&mut page, &often, &scenarios, names);
    let forces = least_and_most(&scenarios);
    how_hard(&mut page, &hard, &scenarios, names, forces);
    let panels = scenarios.len().max(2) as f64;
    let all = Panel {
        top: hard.bottom() + 46.0,
        height: 84.0,
        width: (WIDTH - BETWEEN * (panels - 1.0)) / panels,
        ..often
    };
    all.heading(&mut page, "c", "all samples, zeros included");
    for (place, of_scenario) in scenarios.iter().enumerate() {
        let panel = Panel { left: LEFT + place as f64 * (all.width + BETWEEN), ..all };
        over_all_samples(&mut page, &panel, of_scenario, names, forces, place == 0);
    }
    let lines = [
        "b: boxes: quartiles, median; lines: 5 to 95 %; dots: largest force;",
        "links with at least 20 samples in contact; c: a line is a link, and",
        "its points are the quantiles of b and the largest force",
    ];
    remarks(&mut page, 355.0, lines);
    Ok(Drawing { page, data })
}

/// The rows of each scenario's dataset with the lowest seed.
fn of_first_datasets(rows: DataFrame) -> Result<DataFrame, FigureError> {
    let (scenarios, datasets) = (texts(&rows, "scenario")?, dataset_seeds(&rows)?);
    let mut first: BTreeMap<&str, u64> = BTreeMap::new();
    for (scenario, dataset) in scenarios.iter().zip(&datasets) {
        let lowest = first.entry(scenario).or_insert(*dataset);
        *lowest = *dataset.min(lowest);
    }
    let is_first =
        scenarios.iter().zip(&datasets).map(|(scenario, dataset)| first[scenario.as_str()] == *dataset);
    Ok(rows.filter(&BooleanChunked::from_iter_values("is_first".into(), is_first))?)
}

/// The links of each of these scenarios that has rows.
fn by_scenario(
    rows: &DataFrame,
    wanted: Vec<(String, &'static str)>,
) -> Result<Vec<OfScenario>, FigureError> {
    let (scenarios, links) = (texts(rows, "scenario")?, integers(rows, "link")?);
    let column = |name: &str| reals(rows, name);
    let (samples, contacts, mean) = (column("samples")?, column("contacts")?, column("mean")?);
    let (p05, p25, p50) = (column("p05")?, column("p25")?, column("p50")?);
    let (p75, p95, max) = (column("p75")?, column("p95")?, column("max")?);
    let link = |row: usize| Link {
        index: links[row] as usize,
        samples: samples[row].unwrap_or_default(),
        contacts: contacts[row].unwrap_or_default(),
        mean: mean[row].unwrap_or_default(),
        quantiles: match [p05[row], p25[row], p50[row], p75[row], p95[row]] {
            [Some(p05), Some(p25), Some(p50), Some(p75), Some(p95)] => Some([p05, p25, p50, p75, p95]),
            _ => None,
        },
        max: max[row],
    };
    let of = |(name, color): (String, &'static str)| {
        let own = (0..rows.height()).filter(|row| scenarios[*row] == name);
        OfScenario { links: own.map(link).collect(), name, color }
    };
    Ok(wanted.into_iter().map(of).filter(|of| !of.links.is_empty()).collect())
}

/// Whether a link has enough samples in contact to show its quantiles.
fn is_touched(link: &&Link) -> bool {
    link.contacts >= FEWEST
}

/// The least and the largest force that is shown, N.
fn least_and_most(scenarios: &[OfScenario]) -> [f64; 2] {
    let shown = || scenarios.iter().flat_map(|of| &of.links).filter(is_touched);
    let least = shown().filter_map(|link| Some(link.quantiles?[0])).fold(0.1, f64::min);
    [least, shown().filter_map(|link| link.max).fold(1.0, f64::max)]
}

/// The horizontal middle of a link's bar and the bar's width, points. Bars of several scenarios are beside each other.
fn place_of(panel: &Panel, link: &Link, count: usize, scenario: usize, scenarios: usize) -> [f64; 2] {
    let slot = panel.width / count as f64;
    let aside = (scenario as f64 - (scenarios as f64 - 1.0) / 2.0) * slot * 0.42;
    [panel.left + (link.index as f64 + 0.5) * slot + aside, slot * 0.38]
}

fn how_often(page: &mut Page, panel: &Panel, scenarios: &[OfScenario], names: &Names) {
    let count = names.ticks.len();
    let share = |link: &Link| 100.0 * link.contacts / link.samples;
    let most = scenarios.iter().flat_map(|of| &of.links).map(share).fold(1.0, f64::max);
    let scale = Scale::linear(0.0, most, 4, panel.upwards());
    panel.left_axis(page, &scale, Some("samples in contact (%)"));
    for (place, OfScenario { color, links, .. }) in scenarios.iter().enumerate() {
        for link in links {
            let [x, bar] = place_of(panel, link, count, place, scenarios.len());
            let y = scale.at(share(link));
            page.rectangle([x - bar / 2.0, y], [bar, panel.bottom() - y], 0.0, color, None);
        }
    }
    panel.bottom_ticks(page, &panel.slots(count));
    panel.heading(page, "a", "how often a link is touched");
}

fn how_hard(page: &mut Page, panel: &Panel, scenarios: &[OfScenario], names: &Names, forces: [f64; 2]) {
    let count = names.ticks.len();
    let scale = Scale::logarithmic(forces[0], forces[1], panel.upwards());
    panel.left_axis(page, &scale, Some("force in contact (N)"));
    for (place, OfScenario { color, links, .. }) in scenarios.iter().enumerate() {
        for link in links.iter().filter(is_touched) {
            let [x, bar] = place_of(panel, link, count, place, scenarios.len());
            let (Some(quantiles), Some(max)) = (link.quantiles, link.max) else { continue };
            let [p05, p25, p50, p75, p95] = quantiles.map(|force| scale.at(force));
            page.line([x, p05], [x, p95], Stroke::new(color, 0.7));
            page.rectangle([x - bar / 2.0, p75], [bar, (p25 - p75).max(0.5)], 0.0, color, None);
            page.line([x - bar / 2.0, p50], [x + bar / 2.0, p50], Stroke::new(WHITE, 0.8));
            page.mark(Mark::Disc, [x, scale.at(max)], 0.9, color, false);
        }
    }
    panel.bottom_names(page, &panel.slots(count), &names.ticks, &names.axis);
    panel.heading(page, "b", "how hard, while it is touched");
}

/// Draws the share of all samples whose force is at least as large as a given force, for a few links. The points are
/// exact: they are at the table's quantiles and at the largest force.
fn over_all_samples(
    page: &mut Page,
    panel: &Panel,
    OfScenario { color, links, .. }: &OfScenario,
    names: &Names,
    forces: [f64; 2],
    first: bool,
) {
    let samples = links.iter().map(|link| link.samples).fold(1.0, f64::max);
    // The links' numbers need room at the left.
    let x = Scale::logarithmic(forces[0] / 4.0, forces[1], panel.across());
    let y = Scale::logarithmic(100.0 / samples, 100.0, panel.upwards());
    panel.left_axis(page, &y, first.then_some("samples with ≥ force (%)"));
    panel.bottom_axis(page, &x, Some("force (N)"));
    let color = *color;
    let mut often: Vec<&Link> = links.iter().collect();
    often.sort_by(|a, b| b.contacts.total_cmp(&a.contacts).then(a.index.cmp(&b.index)));
    let shown: Vec<usize> = match names.is_finger {
        true => FROM_TIP.iter().filter_map(|from_tip| names.ticks.len().checked_sub(from_tip + 1)).collect(),
        false => often.iter().take(MOST_TOUCHED).map(|link| link.index).collect(),
    };
    let is_shown = |link: &&Link| shown.contains(&link.index);
    for link in links.iter().filter(is_touched).filter(is_shown) {
        let (Some(quantiles), Some(max)) = (link.quantiles, link.max) else { continue };
        let share = |part: f64| 100.0 * part * link.contacts / link.samples;
        let known = quantiles.into_iter().zip(MORE_THAN.map(share)).chain([(max, 100.0 / link.samples)]);
        let points: Vec<Point> = known.map(|(force, share)| [x.at(force), y.at(share)]).collect();
        page.path(&points, Stroke::new(color, 0.9));
        for point in &points {
            page.mark(Mark::Disc, *point, 1.1, color, false);
        }
        page.text(
            &link.index.to_string(),
            [points[0][0] - 3.0, points[0][1] + 2.1],
            Type::SMALL.end().color(color),
        );
    }
    let forces: f64 = links.iter().map(|link| link.mean * link.samples).sum();
    let over = |of: fn(&Link) -> f64| forces / links.iter().map(of).sum::<f64>();
    let means = [
        format!("mean of all links: {:.2} N,", over(|link| link.samples)),
        format!("in contact: {:.1} N", over(|link| link.contacts)),
    ];
    for (row, text) in means.iter().enumerate() {
        page.text(
            text,
            [panel.left + 3.0, panel.bottom() - 10.5 + 7.5 * row as f64],
            Type::SMALL.start().color(color),
        );
    }
}
