//! How often each link of the finger is touched, and how hard.

use super::axes::{Panel, Scale, colour_legend, colour_of, remark};
use super::page::{COLUMN, Page, Stroke, WHITE};
use super::source::{Source, Study, integers, reals, texts};
use super::{Drawing, FigureError};
use harness_spec::{Modality, Scenario};

const LEFT: f64 = 30.0;
const WIDTH: f64 = COLUMN - LEFT - 5.0;

/// Contacts below which a link's quartiles would mean nothing.
const FEWEST: i64 = 20;

/// What the forces table is asked for.
pub const SQL: &str = "select scenario, index as link, modality, 'N' as unit, \
    max(samples) as samples, max(contacts) as contacts, max(100.0 * contacts / samples) as contact_percent, \
    max(mean) as mean, max(p05) as p05, max(p25) as p25, max(p50) as p50, max(p75) as p75, max(p95) as p95, \
    max(max) as max from forces where modality = 'contact_force' and episode is null \
    group by scenario, index, modality order by scenario, link";

pub fn draw(source: &Source) -> Result<Drawing, FigureError> {
    // Both studies are about the same datasets.
    let runs = source
        .runs(Study::SingleToMulti)
        .or_else(|error| source.runs(Study::MultiToMulti).map_err(|_| error))?;
    let data = runs.query(SQL)?;
    let (scenarios, links) = (texts(&data, "scenario")?, integers(&data, "link")?);
    let column = |name: &str| reals(&data, name);
    let (share, contacts) = (column("contact_percent")?, integers(&data, "contacts")?);
    let quantiles = [column("p05")?, column("p25")?, column("p50")?, column("p75")?, column("p95")?];

    let count = runs.layout()[Modality::CONTACT_FORCE].width();
    let mut page = Page::new(COLUMN, 246.0, "Contacts and contact forces by link of the finger");
    let shown: Vec<_> = Scenario::PAPER
        .iter()
        .filter(|scenario| scenarios.iter().any(|name| name == scenario.name()))
        .collect();
    let entries: Vec<_> = shown.iter().map(|scenario| (colour_of(**scenario), scenario.name())).collect();
    colour_legend(&mut page, COLUMN / 2.0, 9.0, &entries);
    let often = Panel { left: LEFT, top: 26.0, width: WIDTH, height: 62.0 };
    let hard = Panel { top: often.bottom() + 30.0, height: 92.0, ..often };
    let most = share.iter().flatten().copied().fold(1.0, f64::max);
    let often_scale = Scale::linear(0.0, most, 4, often.upwards());
    let ends = |values: &[Option<f64>]| {
        let values = values.iter().flatten().copied();
        (values.clone().fold(f64::INFINITY, f64::min), values.fold(0.0, f64::max))
    };
    // Below a hundredth of a newton nothing is felt.
    let (low, high) = (ends(&quantiles[0]).0.max(0.01), ends(&quantiles[4]).1.max(0.1));
    let hard_scale = Scale::logarithmic(low.min(high / 10.0), high, hard.upwards());
    often.left_axis(&mut page, &often_scale, Some("samples in contact (%)"));
    hard.left_axis(&mut page, &hard_scale, Some("force in contact (N)"));
    for (row, (scenario, link)) in scenarios.iter().zip(&links).enumerate() {
        let Some(place) = shown.iter().position(|shown| shown.name() == scenario) else { continue };
        let colour = colour_of(*shown[place]);
        let slot = WIDTH / count as f64;
        let bar = slot * 0.38;
        let x = LEFT
            + (*link as f64 + 0.5) * slot
            + (place as f64 - (shown.len() as f64 - 1.0) / 2.0) * slot * 0.42;
        if let Some(share) = share[row] {
            let y = often_scale.at(share);
            page.rectangle([x - bar / 2.0, y], [bar, often.bottom() - y], 0.0, colour, None);
        }
        let at =
            |quantile: usize| quantiles[quantile][row].map(|force| hard_scale.at(hard_scale.clamp(force)));
        if contacts[row] < FEWEST {
            continue;
        }
        if let [Some(p05), Some(p25), Some(p50), Some(p75), Some(p95)] = [0, 1, 2, 3, 4].map(at) {
            page.line([x, p05], [x, p95], Stroke::new(colour, 0.7));
            page.rectangle([x - bar / 2.0, p75], [bar, (p25 - p75).max(0.5)], 0.0, colour, None);
            page.line([x - bar / 2.0, p50], [x + bar / 2.0, p50], Stroke::new(WHITE, 0.8));
        }
    }
    let names: Vec<String> =
        (0..count).map(|link| if link % 2 == 0 { link.to_string() } else { String::new() }).collect();
    often.bottom_names(&mut page, &often.slots(count), &vec![String::new(); count], "");
    hard.bottom_names(
        &mut page,
        &hard.slots(count),
        &names,
        &format!("link of the finger, 0 at the base, {} at the tip", count - 1),
    );
    often.heading(&mut page, "a", "how often a link is touched");
    hard.heading(&mut page, "b", "how hard, while it is touched");
    remark(
        &mut page,
        "box: quartiles and median; line: 5 to 95 % of at least 20 samples in contact",
        [COLUMN / 2.0, 241.0],
    );
    Ok(Drawing { page, data })
}
