//! The skill of models over persistence, which follows from the errors in the tables.

use super::rows::Row;
use harness_judge::models::PERSISTENCE;
use harness_metrics::Metric;
use harness_metrics::skill::{skill, skill_horizon};
use std::collections::{BTreeMap, HashMap, HashSet};

/// The unit of the skill horizon.
const SAMPLES: &str = "samples";

/// The skill of each model other than persistence, at each horizon for which `rows` have its RMSE and that of
/// persistence. Like R2, it is not defined where the reference varies only by round-off, which is persistence's error.
pub(super) fn skills<'a>(rows: &[Row<'a>]) -> Vec<Row<'a>> {
    let errors = || rows.iter().filter(|row| row.metric == Metric::Rmse.name());
    let key = |row: &Row<'a>| (row.experiment, row.run, row.task, row.modality, row.direction, row.horizon);
    let relative = [Metric::R2, Metric::RelativeError].map(Metric::name);
    let varying: HashSet<_> =
        rows.iter().filter(|row| relative.contains(&row.metric) && row.value.is_some()).map(key).collect();
    let persistence: HashMap<_, f64> = errors()
        .filter(|row| row.model == PERSISTENCE && varying.contains(&key(row)))
        .filter_map(|row| Some((key(row), row.value?)))
        .collect();
    let of_model = |row: &Row<'a>| {
        let value = skill(row.value?, *persistence.get(&key(row))?)?;
        Some(Row { metric: Metric::Skill.name(), unit: "1", value: Some(value), ..*row })
    };
    errors().filter(|row| row.model != PERSISTENCE).filter_map(of_model).collect()
}

/// The skill horizon of each model whose skill at several horizons is among `skills`.
pub(super) fn skill_horizons<'a>(skills: &[Row<'a>]) -> Vec<Row<'a>> {
    let mut by_model: BTreeMap<_, BTreeMap<usize, Row<'a>>> = BTreeMap::new();
    for row in skills {
        let model = (row.experiment, row.run, row.task, row.model, row.given, row.modality, row.direction);
        by_model.entry(model).or_default().extend(row.horizon.map(|horizon| (horizon, *row)));
    }
    let of_model = |by_horizon: BTreeMap<usize, Row<'a>>| {
        let values = by_horizon.iter().filter_map(|(horizon, row)| Some((*horizon, row.value?)));
        let value = Some(skill_horizon(values) as f64);
        let first = *by_horizon.values().next()?;
        Some(Row { metric: Metric::SkillHorizon.name(), unit: SAMPLES, value, horizon: None, ..first })
    };
    by_model.into_values().filter_map(of_model).collect()
}
