//! Judges the claims under each reading of the paper and lists the choices that change a verdict.

use super::verdicts::class_of;
use super::{Absent, Asked, Part, ReportError, sentence};
use harness_analysis::Analysis;
use harness_claims::{self as claims, Claim, Contacts, Judgment, MatrixRow};
use harness_registry::Registry;
use harness_spec::{Experiment, QUICK, Reading, Scenario};
use serde::Serialize;

/// The verdicts of claims under each reading.
#[derive(Serialize)]
pub struct Readings {
    /// The readings except for the base.
    readings: Vec<Choice>,
    rows: Vec<Row>,
    /// The number of rows with the same verdict under every reading.
    same: usize,
    /// The number of claims that need runs that no reading has.
    left_out: usize,
    notes: Vec<String>,
    /// How often links are touched in the datasets of each reading.
    contacts: Vec<String>,
}

/// A reading: a choice that differs from the base.
#[derive(Serialize)]
struct Choice {
    name: String,
    choice: String,
    base: String,
    instead: String,
    paper: String,
}

/// A claim in a scenario.
#[derive(Serialize)]
struct Row {
    id: String,
    scenario: &'static str,
    /// The verdict under each reading, the base first.
    cells: Vec<Cell>,
    changes: Vec<Change>,
}

/// A verdict under a reading.
#[derive(Serialize)]
struct Cell {
    class: &'static str,
    verdict: String,
    value: String,
    /// Whether the verdict differs from the base's, and one of the two is decided.
    changed: bool,
}

/// A reading that changes a row's verdict.
#[derive(Serialize)]
struct Change {
    /// The index of the reading's cell in the row. The base has index 0.
    place: usize,
    name: String,
}

/// Judges the claims with the runs of the experiment `spec`, which has readings. Returns [`Part::Absent`] if the
/// experiment has no finished runs.
///
/// # Errors
/// When a claim's query is wrong, or a table is damaged.
pub fn of(
    registry: &Registry,
    analysis: &Analysis,
    spec: &Experiment,
    claims: &[&Claim],
    asked: &Asked,
) -> Result<Part<Readings>, ReportError> {
    if analysis.runs(&spec.name).is_empty() {
        let quick = spec.name.strip_suffix(QUICK);
        let command = analysis.command(quick.unwrap_or(&spec.name), quick.is_some());
        let reason = format!("There is no finished run of {}.", spec.name);
        return Ok(Part::Absent(Absent { reason, command }));
    }
    let readings = claims::Readings::new(registry, spec, claims, &asked.settings)?;
    let matrix = readings.judge(claims)?;
    let contacts = claims::contacts(readings.analysis(), &[&spec.name])?;
    let rows: Vec<Row> = matrix.rows.iter().map(|row| Row::new(row, &matrix.readings)).collect();
    Ok(Part::There(Readings {
        readings: spec.readings.iter().map(Choice::new).collect(),
        same: rows.iter().filter(|row| row.changes.is_empty()).count(),
        rows,
        left_out: matrix.left_out.len(),
        notes: matrix.notes.iter().map(|note| sentence(note)).collect(),
        contacts: contacts.iter().map(Contacts::to_string).collect(),
    }))
}

impl Choice {
    fn new(reading: &Reading) -> Self {
        let Reading { name, choice, base, instead, paper, .. } = reading.clone();
        Self { name: name.replace('_', " "), choice, base, instead, paper }
    }
}

impl Row {
    fn new(row: &MatrixRow, readings: &[&str]) -> Self {
        let changes: Vec<usize> = row.changes().map(|(place, _)| place).collect();
        let cell = |(place, judgment): (usize, &Judgment)| Cell {
            class: class_of(judgment.verdict()),
            verdict: judgment.verdict().to_string(),
            value: judgment.interval().map_or_else(|| "no value".into(), |interval| interval.to_string()),
            changed: changes.contains(&place),
        };
        Self {
            id: row.claim.id().to_owned(),
            scenario: row.scenario.map_or("both", Scenario::name),
            cells: row.judgments.iter().enumerate().map(cell).collect(),
            changes: changes
                .iter()
                .map(|&place| Change { place, name: readings[place].replace('_', " ") })
                .collect(),
        }
    }
}
