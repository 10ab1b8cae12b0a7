//! The table of `harness world check`: whether worlds are fit for learning.

use super::DONE;
use super::format::{Form, print_page};
use super::sheet::Style;
use super::table::{Grid, print_text};
use anyhow::Result;
use harness::numbers::counted;
use harness::simulation::{Finding, Limit, Scene, SimulationError, fitness};
use polars::prelude::{Column, DataFrame};
use std::collections::BTreeSet;
use std::process::ExitCode;

/// Prints or writes whether worlds are fit for learning, from the first `episodes` of each.
pub fn judge(scenes: &[Scene], episodes: u32, form: Form) -> Result<ExitCode> {
    let found: Vec<Vec<Finding>> =
        scenes.iter().map(|scene| fitness(scene, episodes)).collect::<Result<_, _>>()?;
    let names: Vec<&str> = scenes.iter().map(|scene| scene.scenario().name()).collect();
    match form {
        Form::Data(data) => return data.write(&mut table(&names, &found)?, "finding"),
        Form::Page(style) => print_page(grid(&names, &found, style), style),
    }
    Ok(ExitCode::from(DONE))
}

/// Prints whether a world is fit for learning, and what changes the values that are not, or that it diverges.
pub fn print_judgement(scene: &Scene, episodes: u32) -> Result<()> {
    let found = match fitness(scene, episodes) {
        Err(error @ SimulationError::Diverged { .. }) => {
            print_text(&format!("note: recording fails: {error}; a smaller range or longer moves may help"));
            return Ok(());
        }
        found => found?,
    };
    println!("\nFitness for learning, in {}:", counted(episodes as usize, "episode"));
    let names = [scene.scenario().name()];
    print_page(grid(&names, std::slice::from_ref(&found), Style::Text), Style::Text);
    let beyond: Vec<&Finding> = found.iter().filter(|finding| !finding.holds()).collect();
    for alike in beyond.chunk_by(|one, other| one.advice == other.advice) {
        let said: Vec<String> = alike.iter().copied().map(note).collect();
        print_text(&format!("note: {}: {}", said.join("; "), alike[0].advice));
    }
    print_text(&match beyond.len() {
        0 => "fit for learning: every value is within its limit".to_owned(),
        count => format!("not fit for learning: {} beyond the limit, marked with !", counted(count, "value")),
    });
    Ok(())
}

/// Says what is wrong with a value.
fn note(finding: &Finding) -> String {
    let is = if matches!(finding.limit, Some(Limit::AtLeast(_))) { "below" } else { "above" };
    let of = if finding.of.is_empty() { String::new() } else { format!(" ({})", finding.of) };
    let (value, limit) = (number(finding.value.unwrap_or_default()), limit(finding));
    let limit = limit.trim_start_matches(['<', '>', '=', ' ']);
    format!("{} is {value}{of}, {is} {limit}", named(finding))
}

fn named(finding: &Finding) -> String {
    let unit = if finding.unit.is_empty() { String::new() } else { format!(", {}", finding.unit) };
    finding.name.to_owned() + &unit
}

fn limit(finding: &Finding) -> String {
    match finding.limit {
        Some(Limit::AtMost(limit)) => format!("<= {}", number(limit)),
        Some(Limit::AtLeast(limit)) => format!(">= {}", number(limit)),
        None => String::new(),
    }
}

/// Two significant digits of small numbers, and all digits before the point of large ones.
fn number(value: f64) -> String {
    match value.abs() {
        0.0 => "0".into(),
        size if size < 0.0995 => format!("{value:.3}"),
        size if size < 9.95 => format!("{value:.2}"),
        size if size < 99.5 => format!("{value:.1}"),
        _ => format!("{value:.0}"),
    }
}

/// A row for each finding that some world has, and a column for each world. What is beyond its limit is marked.
fn grid(names: &[&str], found: &[Vec<Finding>], style: Style) -> Grid {
    let cell = |finding: &Finding| {
        let value = finding.value.map_or("-".into(), number);
        match (finding.holds(), style) {
            (true, _) => value,
            (false, Style::Markdown) => format!("**{value}**"),
            (false, _) => format!("!{value}"),
        }
    };
    // A limit that depends on the world is written for each.
    let limits = |row: usize| {
        let all: BTreeSet<String> = found.iter().map(|of| limit(&of[row])).collect();
        let all: Vec<&str> =
            all.iter().enumerate().map(|(place, one)| if place > 0 { &one[3..] } else { one }).collect();
        all.join(" or ")
    };
    let has_value = |row: &usize| found.iter().any(|of| of[*row].value.is_some());
    let row = |row: usize| {
        let cells = found.iter().map(|of| cell(&of[row]));
        [named(&found[0][row]), limits(row)].into_iter().chain(cells).collect()
    };
    let is_right = |column: usize| column > 1;
    Grid {
        header: ["", "limit"].iter().chain(names).map(|name| (*name).to_owned()).collect(),
        rows: (0..found.first().map_or(0, Vec::len)).filter(has_value).map(row).collect(),
        right: (0..names.len() + 2).map(is_right).collect(),
        ..Grid::default()
    }
}

/// A row for each world and finding, with all digits.
fn table(names: &[&str], found: &[Vec<Finding>]) -> Result<DataFrame> {
    let rows: Vec<(&str, &Finding)> =
        names.iter().zip(found).flat_map(|(name, found)| found.iter().map(|one| (*name, one))).collect();
    let of = |bound: fn(Limit) -> Option<f64>| -> Vec<Option<f64>> {
        rows.iter().map(|(_, one)| one.limit.and_then(bound)).collect()
    };
    let texts = |text: fn(&Finding) -> &str| rows.iter().map(|(_, one)| text(one)).collect::<Vec<_>>();
    let least = |limit| if let Limit::AtLeast(limit) = limit { Some(limit) } else { None };
    let most = |limit| if let Limit::AtMost(limit) = limit { Some(limit) } else { None };
    let columns = vec![
        Column::new("world".into(), rows.iter().map(|(name, _)| *name).collect::<Vec<_>>()),
        Column::new("finding".into(), texts(|one| one.name)),
        Column::new("unit".into(), texts(|one| one.unit)),
        Column::new("value".into(), rows.iter().map(|(_, one)| one.value).collect::<Vec<_>>()),
        Column::new("at_least".into(), of(least)),
        Column::new("at_most".into(), of(most)),
        Column::new("holds".into(), rows.iter().map(|(_, one)| one.holds()).collect::<Vec<_>>()),
        Column::new("of".into(), texts(|one| &one.of)),
        Column::new("advice".into(), texts(|one| one.advice)),
    ];
    Ok(DataFrame::new(rows.len(), columns)?)
}
