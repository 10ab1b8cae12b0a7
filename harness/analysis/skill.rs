//! The skill of models over persistence, which follows from the errors in the tables.

use super::rows::Row;
use harness_judge::models::PERSISTENCE;
use harness_metrics::Metric;
use harness_metrics::skill::{skill, skill_horizon};
use std::collections::{BTreeMap, HashMap};

/// The unit of the skill horizon.
const SAMPLES: &str = "samples";

/// The skill of each model other than persistence, at each horizon for which `rows` have its RMSE and that of
/// persistence.
pub(super) fn skills(rows: &[Row]) -> Vec<Row> {
    let errors = || rows.iter().filter(|row| row.metric == Metric::Rmse.name());
    let key = |row: &Row| {
        let Row { run, modality, direction, horizon, .. } = row;
        (row.experiment.clone(), run.clone(), row.task, *modality, direction.clone(), *horizon)
    };
    let persistence: HashMap<_, f64> =
        errors().filter(|row| row.model == PERSISTENCE).map(|row| (key(row), row.value)).collect();
    let of_model = |row: &Row| {
        let value = skill(row.value, *persistence.get(&key(row))?)?;
        Some(Row { metric: Metric::Skill.name().to_owned(), unit: "1".to_owned(), value, ..row.clone() })
    };
    errors().filter(|row| row.model != PERSISTENCE).filter_map(of_model).collect()
}

/// The skill horizon of each model whose skill at several horizons is among `skills`.
pub(super) fn skill_horizons(skills: &[Row]) -> Vec<Row> {
    let mut by_model: BTreeMap<_, BTreeMap<usize, &Row>> = BTreeMap::new();
    for row in skills {
        let model = (&row.experiment, &row.run, row.task, &row.model, row.modality, &row.direction);
        by_model.entry(model).or_default().extend(row.horizon.map(|horizon| (horizon, row)));
    }
    let of_model = |by_horizon: BTreeMap<usize, &Row>| {
        let value = skill_horizon(by_horizon.iter().map(|(horizon, row)| (*horizon, row.value))) as f64;
        let (metric, unit) = (Metric::SkillHorizon.name().to_owned(), SAMPLES.to_owned());
        Some(Row { metric, unit, value, horizon: None, ..(*by_horizon.values().next()?).clone() })
    };
    by_model.into_values().filter_map(of_model).collect()
}
