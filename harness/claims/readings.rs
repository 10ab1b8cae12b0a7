//! Judges claims under several readings of the paper, to find the readings that change a verdict.

use super::{Claim, ClaimsError, Evidence, Judgment, Sizes, Verdict};
use harness_analysis::{Analysis, AnalysisError, Selection, Setting};
use harness_registry::{Recorded, Registry};
use harness_spec::{Experiment, Reading, Scenario};
use polars::prelude::{Column, DataFrame, PolarsResult};
use std::collections::{BTreeMap, BTreeSet};

/// The name of the judgments by the claims' own experiments in a [`Matrix`].
pub const OWN: &str = "own experiments";

/// The judgments of claims under all readings.
pub struct Matrix<'a> {
    /// The names of the readings, the base reading first. [`OWN`] comes last if the claims were judged by their own
    /// experiments too.
    pub readings: Vec<&'a str>,
    /// A row for each claim and scenario that a reading has runs for.
    pub rows: Vec<Row<'a>>,
    /// The claims that no reading has runs for.
    pub left_out: Vec<&'a Claim>,
    /// Messages about runs that were left out; see [`Analysis::notes`].
    pub notes: Vec<String>,
}

/// The judgments of a claim in a scenario, under each reading.
pub struct Row<'a> {
    /// The claim.
    pub claim: &'a Claim,
    /// The scenario, or `None` if the claim is about both together.
    pub scenario: Option<Scenario>,
    /// A judgment for each reading, in the order of [`Matrix::readings`].
    pub judgments: Vec<Judgment<'a>>,
}

impl Matrix<'_> {
    /// Removes the readings that no claim has data under.
    pub fn without_empty(mut self) -> Self {
        let has_data =
            |place: usize| self.rows.iter().any(|row| row.judgments[place].verdict() != Verdict::NoData);
        let kept: Vec<bool> = (0..self.readings.len()).map(has_data).collect();
        retain(&mut self.readings, &kept);
        self.rows.iter_mut().for_each(|row| retain(&mut row.judgments, &kept));
        self
    }

    /// Whether a reading has judgments, and not the claims' own experiments alone.
    fn has_readings(&self) -> bool {
        self.readings.iter().any(|name| *name != OWN)
    }

    /// The judgments under the reading at a position in [`Self::readings`].
    pub fn column(&self, place: usize) -> impl Iterator<Item = &Judgment<'_>> {
        self.rows.iter().map(move |row| &row.judgments[place])
    }

    /// The judgments under each reading, with its name.
    pub fn columns(&self) -> impl Iterator<Item = (&str, Vec<&Judgment<'_>>)> {
        self.readings.iter().enumerate().map(|(place, name)| (*name, self.column(place).collect()))
    }

    /// The claims that a reading has runs for, in the order of the file.
    pub fn claims(&self) -> Vec<&Claim> {
        let mut claims: Vec<&Claim> = self.rows.iter().map(|row| row.claim).collect();
        claims.dedup_by_key(|claim| claim.id());
        claims
    }

    /// Converts the judgments to a table with a row for each judgment under each reading. P-values are corrected for
    /// the number of tests under a reading.
    ///
    /// # Errors
    /// When Polars can't build the table.
    pub fn table(&self) -> PolarsResult<DataFrame> {
        let of_reading = |(name, judgments): (&str, Vec<&Judgment>)| {
            let mut table = super::table(&judgments)?;
            table.insert_column(0, Column::new("reading".into(), vec![name; table.height()]))?;
            Ok(table)
        };
        let mut tables = self.columns().map(of_reading);
        let mut all = tables.next().unwrap_or_else(|| super::table(&[]))?;
        tables.try_for_each(|table| all.vstack_mut(&table?).map(drop))?;
        Ok(all)
    }
}

/// Keeps the elements of which `kept` says so.
fn retain<T>(values: &mut Vec<T>, kept: &[bool]) {
    let mut kept = kept.iter();
    values.retain(|_| *kept.next().unwrap_or(&false));
}

/// The runs of an experiment with readings.
pub struct Readings<'a> {
    spec: &'a Experiment,
    analysis: Analysis,
}

impl<'a> Readings<'a> {
    /// Finds those runs of a results folder, `recorded`, that have the spec's name and these settings, and announces
    /// the queries of `claims`.
    ///
    /// # Errors
    /// When no run has one of the requested settings, or its value.
    pub fn of(
        registry: &Registry,
        recorded: Vec<Recorded>,
        spec: &'a Experiment,
        claims: &[&Claim],
        settings: &[Setting],
    ) -> Result<Self, AnalysisError> {
        let experiments = vec![spec.name.clone()];
        let (settings, trained) = (settings.to_vec(), experiments.clone());
        let selection = Selection { experiments, settings, simulated: true, trained };
        let mut readings = Self { spec, analysis: Analysis::of(registry, recorded, &selection)? };
        let mut queries = BTreeSet::new();
        for reading in spec.names_of_readings() {
            for claim in claims {
                let sizes = readings.sizes(claim, reading);
                queries.extend(claim.queries().map(|query| claim.complete(&query.value, &sizes, false)));
            }
        }
        readings.analysis = readings.analysis.expect(queries.iter().map(String::as_str));
        Ok(readings)
    }

    /// The runs that the readings are judged by.
    pub fn analysis(&self) -> &Analysis {
        &self.analysis
    }

    /// Judges claims under every reading.
    ///
    /// # Errors
    /// When a query is invalid, or its answer does not have the columns and rows of a claim.
    pub fn judge<'c>(&self, claims: &[&'c Claim]) -> Result<Matrix<'c>, ClaimsError>
    where
        'a: 'c,
    {
        self.judge_with(claims, self.spec.names_of_readings(), |_| Ok(None))
    }

    /// Judges claims under every reading that has runs, and by the `runs` of their own experiments. Returns `None` if
    /// no reading has runs.
    ///
    /// # Errors
    /// Like [`Self::judge`].
    pub fn judge_beside<'c>(
        &self,
        claims: &[&'c Claim],
        runs: &Analysis,
        quick: bool,
    ) -> Result<Option<Matrix<'c>>, ClaimsError>
    where
        'a: 'c,
    {
        let readings = self.spec.names_of_readings().into_iter().chain([OWN]).collect();
        let matrix = self.judge_with(claims, readings, |claim| super::judge(runs, claim, quick).map(Some))?;
        Ok(Some(matrix.without_empty()).filter(Matrix::has_readings))
    }

    fn judge_with<'c>(
        &self,
        claims: &[&'c Claim],
        readings: Vec<&'c str>,
        own: impl Fn(&'c Claim) -> Result<Option<Vec<Judgment<'c>>>, ClaimsError>,
    ) -> Result<Matrix<'c>, ClaimsError>
    where
        'a: 'c,
    {
        let (mut rows, mut left_out) = (Vec::new(), Vec::new());
        for &claim in claims {
            let judged =
                self.spec.names_of_readings().into_iter().map(|reading| self.judge_under(claim, reading));
            let mut judged: Vec<Vec<Judgment<'c>>> = judged.collect::<Result<_, _>>()?;
            judged.extend(own(claim)?);
            let mut own = by_scenario(claim, judged);
            own.retain(|row| row.judgments.iter().any(|judgment| judgment.verdict() != Verdict::NoData));
            if own.is_empty() {
                left_out.push(claim);
            }
            rows.append(&mut own);
        }
        Ok(Matrix { readings, rows, left_out, notes: self.analysis.notes().to_vec() })
    }

    fn judge_under<'c>(&self, claim: &'c Claim, reading: &str) -> Result<Vec<Judgment<'c>>, ClaimsError> {
        let experiments = claim.experiments.iter().map(|role| {
            let runs = self.analysis.runs_under(&self.spec.name, reading, role);
            let checked = self.analysis.check_alike(&runs);
            (role.clone(), runs, checked)
        });
        let sizes = self.sizes(claim, reading);
        Evidence::of(&self.analysis, experiments.collect()).judge(claim, &sizes, false)
    }

    /// The claim's latent sizes for which the reading has runs on each of its datasets. An experiment without any
    /// keeps all of its sizes.
    fn sizes(&self, claim: &Claim, reading: &str) -> Sizes {
        let of = |(role, asked): (&String, &BTreeSet<usize>)| {
            let mut by_dataset: BTreeMap<_, BTreeSet<usize>> = BTreeMap::new();
            for run in self.analysis.runs_under(&self.spec.name, reading, role) {
                let spec = &run.record.spec;
                let dataset = (&spec.scenario, spec.dataset_seed());
                by_dataset.entry(dataset).or_default().extend(spec.latent());
            }
            let there = by_dataset.into_values().fold(asked.clone(), |sizes, own| &sizes & &own);
            (role.clone(), if there.is_empty() { asked.clone() } else { there })
        };
        claim.latent.iter().map(of).collect()
    }
}

/// Groups the judgments of a claim under each reading by scenario.
fn by_scenario<'c>(claim: &'c Claim, judged: Vec<Vec<Judgment<'c>>>) -> Vec<Row<'c>> {
    let mut rows: Vec<Row> = Vec::new();
    for judgments in judged {
        for (place, judgment) in judgments.into_iter().enumerate() {
            match rows.get_mut(place) {
                Some(row) => row.judgments.push(judgment),
                None => rows.push(Row { claim, scenario: judgment.scenario, judgments: vec![judgment] }),
            }
        }
    }
    rows
}

/// What a reading of a spec is, or [`OWN`], in words.
pub fn described(spec: &Experiment, name: &str) -> String {
    if name == OWN {
        return "the experiments that the claims name".into();
    }
    match spec.readings.iter().find(|reading| reading.name == name) {
        Some(Reading { choice, instead, .. }) => format!("{}: {choice}: {instead}", spec.name),
        None => match spec.readings.as_slice() {
            [only] => format!("{}: {}", spec.name, only.base),
            _ => format!("{}: the spec's own settings", spec.name),
        },
    }
}
