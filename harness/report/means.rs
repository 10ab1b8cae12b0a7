//! Puts the metrics of networks beside those of the baselines.

use super::{Asked, ReportError};
use harness_analysis::{Analysis, AnalysisError, Part, Question};
use serde::Serialize;

/// The metrics of an experiment's networks in a scenario, and those of the baselines.
#[derive(Serialize)]
pub struct Table {
    experiment: String,
    /// How far ahead the predictions are, in words.
    ahead: Option<String>,
    #[serde(flatten)]
    part: Part,
}

/// Returns the tables of the asked experiments; none on the page of all results.
///
/// # Errors
/// When a table is damaged.
pub fn tables(analysis: &Analysis, asked: &Asked) -> Result<Vec<Table>, ReportError> {
    let metrics = analysis.whole_metrics()?;
    let mut tables = Vec::new();
    for experiment in &asked.experiments {
        let (experiments, metrics) = (vec![experiment.clone()], metrics.clone());
        let answer = match (Question { experiments, metrics, ..Question::default() }).answer(analysis) {
            Err(AnalysisError::NoMeans(_)) => continue,
            answer => answer?,
        };
        let ahead = answer.ahead();
        let table = |part| Table { experiment: experiment.clone(), ahead: ahead.clone(), part };
        tables.extend(answer.parts().into_iter().map(table));
    }
    Ok(tables)
}
