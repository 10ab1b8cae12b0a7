//! Verdicts as a table.

use crate::{Judgment, Requirement, corrected};
use harness_analysis::Interval;
use polars::prelude::{Column, DataFrame, PolarsResult};

/// Converts judgments to a table with one row for each.
///
/// # Errors
/// When Polars can't build the table.
pub fn table(judgments: &[&Judgment]) -> PolarsResult<DataFrame> {
    let text = |name: &str, of: &dyn Fn(&Judgment) -> Option<String>| {
        Column::new(name.into(), judgments.iter().map(|judgment| of(judgment)).collect::<Vec<_>>())
    };
    let numbers = |name: &str, of: &dyn Fn(&Judgment) -> Option<Interval>| {
        let intervals: Vec<Option<Interval>> = judgments.iter().map(|judgment| of(judgment)).collect();
        let column = |end: &str, of: fn(Interval) -> Option<f64>| {
            let values: Vec<Option<f64>> = intervals.iter().map(|interval| interval.and_then(of)).collect();
            Column::new(format!("{name}{end}").into(), values)
        };
        [
            column("mean", |interval| Some(interval.mean)),
            column("low", |interval| interval.bounds.map(|(low, _)| low)),
            column("high", |interval| interval.bounds.map(|(_, high)| high)),
        ]
    };
    let requirement = |name: &str, of: &dyn Fn(&Requirement) -> String| {
        text(name, &|judgment| judgment.claim.requires.as_ref().map(of))
    };
    let counts = judgments.iter().map(|judgment| judgment.measured.count() as i64);
    let datasets = judgments.iter().map(|judgment| judgment.measured.datasets() as i64);
    let mut columns = vec![
        text("claim", &|judgment| Some(judgment.claim.id().to_owned())),
        text("paper", &|judgment| Some(judgment.claim.statement.clone())),
        text("section", &|judgment| Some(judgment.claim.section.clone())),
        text("measured", &|judgment| Some(judgment.claim.measured.clone())),
        text("scenario", &|judgment| judgment.scenario.map(|scenario| scenario.name().to_owned())),
        text("each", &|judgment| Some(judgment.measured.each.name().to_owned())),
        Column::new("datasets".into(), datasets.collect::<Vec<_>>()),
        Column::new("values".into(), counts.collect::<Vec<_>>()),
    ];
    columns.extend(numbers("", &|judgment| judgment.interval()));
    columns.push(text("condition", &|judgment| Some(judgment.claim.condition.to_string())));
    columns.push(requirement("requires", &|requirement| requirement.measured.clone()));
    columns.extend(numbers("required_", &|judgment| judgment.required.as_ref()?.interval()));
    columns.push(requirement("required_condition", &|requirement| requirement.condition.to_string()));
    let p_values: Vec<Option<f64>> = judgments.iter().map(|judgment| judgment.p_value()).collect();
    columns.push(Column::new("p".into(), p_values));
    columns.push(Column::new("p_holm".into(), corrected(judgments.iter().copied())));
    columns.push(text("verdict", &|judgment| Some(judgment.verdict().to_string())));
    DataFrame::new(judgments.len(), columns)
}
