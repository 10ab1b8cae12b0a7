//! Claims under several readings of the paper: which of them change a verdict.

use super::{Claim, ClaimsError, Evidence, Judgement, Sizes, Verdict};
use harness_analysis::{Analysis, AnalysisError, Run, Selection, Setting};
use harness_registry::Registry;
use harness_spec::{Experiment, Reading, Scenario};
use std::collections::BTreeSet;

/// Claims by readings.
pub struct Matrix<'a> {
    /// The readings' names, the base first.
    pub readings: Vec<&'a str>,
    /// One for each claim and scenario that some reading has runs for.
    pub rows: Vec<Row<'a>>,
    /// The claims that no reading has runs for.
    pub left_out: Vec<&'a Claim>,
    /// What was left out that a reader may look for, in words.
    pub notes: Vec<String>,
}

/// A claim in a scenario, judged under each reading in turn.
pub struct Row<'a> {
    pub claim: &'a Claim,
    pub scenario: Option<Scenario>,
    pub judgements: Vec<Judgement<'a>>,
}

impl Row<'_> {
    /// The judgement under the base reading.
    pub fn base(&self) -> &Judgement<'_> {
        &self.judgements[0]
    }

    /// The readings under which something else comes out than under the base, by their place, where either is decided.
    pub fn changes(&self) -> impl Iterator<Item = (usize, &Judgement<'_>)> {
        let base = self.base().verdict();
        let is_decided = |verdict: &Verdict| matches!(verdict, Verdict::Holds | Verdict::DoesNotHold);
        self.judgements.iter().enumerate().skip(1).filter(move |(_, judgement)| {
            let verdict = judgement.verdict();
            verdict != base && (is_decided(&verdict) || is_decided(&base)) && verdict != Verdict::NoData
        })
    }
}

/// The runs of an experiment with readings.
pub struct Readings<'a> {
    spec: &'a Experiment,
    analysis: Analysis,
}

impl<'a> Readings<'a> {
    /// Looks for the runs of the spec's experiment, for these claims.
    ///
    /// # Errors
    /// When no run has a setting that is asked for, or its value.
    pub fn new(
        registry: &Registry,
        spec: &'a Experiment,
        claims: &[&Claim],
        settings: &[Setting],
    ) -> Result<Self, AnalysisError> {
        let experiments = vec![spec.name.clone()];
        let selection = Selection { experiments, settings: settings.to_vec(), simulated: true };
        let mut readings = Self { spec, analysis: Analysis::new(registry, &selection)? };
        let mut queries = BTreeSet::new();
        for reading in readings.names() {
            for claim in claims {
                let sizes = readings.sizes(claim, reading);
                queries.extend(claim.queries().map(|query| claim.complete(&query.value, &sizes, false)));
            }
        }
        readings.analysis = readings.analysis.expect(queries.iter().map(String::as_str));
        Ok(readings)
    }

    /// The readings' names, the base first.
    pub fn names(&self) -> Vec<&'a str> {
        let others = self.spec.readings.iter().map(|reading| reading.name.as_str());
        std::iter::once(Reading::BASE).chain(others).collect()
    }

    /// Judges claims under every reading.
    ///
    /// # Errors
    /// When a query is not understood or doesn't give what a claim needs.
    pub fn judge<'c>(&self, claims: &[&'c Claim]) -> Result<Matrix<'c>, ClaimsError>
    where
        'a: 'c,
    {
        let readings = self.names();
        let (mut rows, mut left_out) = (Vec::new(), Vec::new());
        for &claim in claims {
            let judged = readings.iter().map(|reading| self.judge_under(claim, reading));
            let judged: Vec<Vec<Judgement<'c>>> = judged.collect::<Result<_, _>>()?;
            let mut own = by_scenario(claim, judged);
            own.retain(|row| row.judgements.iter().any(|judgement| judgement.verdict() != Verdict::NoData));
            if own.is_empty() {
                left_out.push(claim);
            }
            rows.append(&mut own);
        }
        Ok(Matrix { readings, rows, left_out, notes: self.analysis.notes().to_vec() })
    }

    fn judge_under<'c>(&self, claim: &'c Claim, reading: &str) -> Result<Vec<Judgement<'c>>, ClaimsError> {
        let experiments = claim.experiments.iter().map(|role| {
            let runs: Vec<_> = self.runs(reading, role).collect();
            let checked = self.analysis.check_alike(&runs);
            (role.clone(), runs, checked)
        });
        let sizes = self.sizes(claim, reading);
        Evidence::of(&self.analysis, experiments.collect()).judge(claim, &sizes, false)
    }

    /// The runs that stand for an experiment under a reading.
    fn runs(&self, reading: &str, role: &str) -> impl Iterator<Item = &Run> {
        self.analysis.runs(&self.spec.name).iter().filter(move |run| {
            let spec = &run.record.spec;
            spec.reading() == Some(reading) && spec.role() == Some(role)
        })
    }

    /// The latent sizes that there are under a reading of those that a claim leaves to its experiments.
    fn sizes(&self, claim: &Claim, reading: &str) -> Sizes {
        let of = |(role, asked): (&String, &BTreeSet<usize>)| {
            let there: BTreeSet<usize> = self.runs(reading, role).map(|run| run.record.spec.latent).collect();
            let there: BTreeSet<usize> = there.intersection(asked).copied().collect();
            (role.clone(), if there.is_empty() { asked.clone() } else { there })
        };
        claim.latent.iter().map(of).collect()
    }
}

/// The judgements of a claim under each reading, scenario by scenario.
fn by_scenario<'c>(claim: &'c Claim, judged: Vec<Vec<Judgement<'c>>>) -> Vec<Row<'c>> {
    let mut rows: Vec<Row> = Vec::new();
    for judgements in judged {
        for (place, judgement) in judgements.into_iter().enumerate() {
            match rows.get_mut(place) {
                Some(row) => row.judgements.push(judgement),
                None => rows.push(Row { claim, scenario: judgement.scenario, judgements: vec![judgement] }),
            }
        }
    }
    rows
}
