//! Judges claims under several readings of the paper, to find the readings that change a verdict.

use super::{Claim, ClaimsError, Evidence, Judgment, Sizes, Verdict};
use harness_analysis::{Analysis, AnalysisError, Run, Selection, Setting};
use harness_registry::Registry;
use harness_spec::{Experiment, Reading, Scenario};
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

    /// The judgments under the reading at a position in [`Self::readings`].
    pub fn column(&self, place: usize) -> impl Iterator<Item = &Judgment<'_>> {
        self.rows.iter().map(move |row| &row.judgments[place])
    }
}

/// Keeps the elements of which `kept` says so.
fn retain<T>(values: &mut Vec<T>, kept: &[bool]) {
    let mut kept = kept.iter();
    values.retain(|_| *kept.next().unwrap_or(&false));
}

impl Row<'_> {
    /// The judgment under the base reading.
    pub fn base(&self) -> &Judgment<'_> {
        &self.judgments[0]
    }

    /// The judgments that differ from the base reading's, if one of the two is decided. Each comes with the position
    /// of its reading in [`Matrix::readings`].
    pub fn changes(&self) -> impl Iterator<Item = (usize, &Judgment<'_>)> {
        let base = self.base().verdict();
        let is_decided = |verdict: &Verdict| matches!(verdict, Verdict::Holds | Verdict::DoesNotHold);
        self.judgments.iter().enumerate().skip(1).filter(move |(_, judgment)| {
            let verdict = judgment.verdict();
            let has_data = verdict != Verdict::NoData && base != Verdict::NoData;
            has_data && verdict != base && (is_decided(&verdict) || is_decided(&base))
        })
    }
}

/// The runs of an experiment with readings.
pub struct Readings<'a> {
    spec: &'a Experiment,
    analysis: Analysis,
}

impl<'a> Readings<'a> {
    /// Finds the runs of the spec's experiment with these settings, and announces the queries of `claims`.
    ///
    /// # Errors
    /// When no run has one of the requested settings, or its value.
    pub fn new(
        registry: &Registry,
        spec: &'a Experiment,
        claims: &[&Claim],
        settings: &[Setting],
    ) -> Result<Self, AnalysisError> {
        let others = spec.readings.iter().flat_map(|reading| reading.runs.values());
        let others: BTreeSet<&String> = others.map(|runs| &runs.experiment).collect();
        let experiments: Vec<String> = std::iter::once(&spec.name).chain(others).cloned().collect();
        let (settings, trained) = (settings.to_vec(), experiments.clone());
        let selection = Selection { experiments, settings, simulated: true, trained };
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

    /// The runs that the readings are judged by.
    pub fn analysis(&self) -> &Analysis {
        &self.analysis
    }

    /// The names of the readings, the base reading first.
    pub fn names(&self) -> Vec<&'a str> {
        let others = self.spec.readings.iter().map(|reading| reading.name.as_str());
        std::iter::once(Reading::BASE).chain(others).collect()
    }

    /// Judges claims under every reading.
    ///
    /// # Errors
    /// When a query is invalid, or its answer does not have the columns and rows of a claim.
    pub fn judge<'c>(&self, claims: &[&'c Claim]) -> Result<Matrix<'c>, ClaimsError>
    where
        'a: 'c,
    {
        self.judge_with(claims, self.names(), |_| Ok(None))
    }

    /// Judges claims under every reading, and by the `runs` of their own experiments.
    ///
    /// # Errors
    /// Like [`Self::judge`].
    pub fn judge_beside<'c>(
        &self,
        claims: &[&'c Claim],
        runs: &Analysis,
        quick: bool,
    ) -> Result<Matrix<'c>, ClaimsError>
    where
        'a: 'c,
    {
        let readings = self.names().into_iter().chain([OWN]).collect();
        self.judge_with(claims, readings, |claim| super::judge(runs, claim, quick).map(Some))
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
            let judged = self.names().into_iter().map(|reading| self.judge_under(claim, reading));
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
            let runs = self.runs(reading, role);
            let checked = self.analysis.check_alike(&runs);
            (role.clone(), runs, checked)
        });
        let sizes = self.sizes(claim, reading);
        Evidence::of(&self.analysis, experiments.collect()).judge(claim, &sizes, false)
    }

    /// The runs that stand for an experiment under a reading: the reading's own or, without any, those of another
    /// experiment that the reading names.
    fn runs(&self, reading: &str, role: &str) -> Vec<&Run> {
        let is_own = |run: &&Run| {
            let spec = &run.record.spec;
            spec.reading() == Some(reading) && spec.role() == Some(role)
        };
        let own: Vec<&Run> = self.analysis.runs(&self.spec.name).iter().filter(is_own).collect();
        let mut named = self.spec.readings.iter().filter(|other| other.name == reading);
        match named.find_map(|reading| reading.runs.get(role)) {
            Some(others) if own.is_empty() => {
                let all = self.analysis.runs(&others.experiment).iter();
                all.filter(|run| run.record.spec.variant == others.variant).collect()
            }
            _ => own,
        }
    }

    /// The claim's latent sizes for which the reading has runs on each of its datasets. An experiment without any
    /// keeps all of its sizes.
    fn sizes(&self, claim: &Claim, reading: &str) -> Sizes {
        let of = |(role, asked): (&String, &BTreeSet<usize>)| {
            let mut by_dataset: BTreeMap<_, BTreeSet<usize>> = BTreeMap::new();
            for run in self.runs(reading, role) {
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
