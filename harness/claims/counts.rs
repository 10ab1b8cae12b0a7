//! Counts verdicts.

use super::{Judgment, Verdict, corrected};
use serde::Serialize;
use std::fmt;

/// The number of judgments with each outcome.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize)]
pub struct Counts {
    /// The claim holds.
    pub holds: usize,
    /// The claim does not hold.
    pub fails: usize,
    /// The runs do not decide the claim.
    pub undecided: usize,
    /// The claim's requirement is not met.
    pub untestable: usize,
    /// There are no runs to judge by.
    pub missing: usize,
    /// The verdicts that Holm's correction makes undecided.
    pub unsure: usize,
    /// The tests that Holm's correction is for.
    pub tests: usize,
}

impl Counts {
    /// Counts the judgments of one reading.
    pub fn of(judgments: &[&Judgment]) -> Self {
        let mut counts = Self::default();
        for (judgment, p) in judgments.iter().zip(corrected(judgments.iter().copied())) {
            *match judgment.verdict() {
                Verdict::Holds => &mut counts.holds,
                Verdict::DoesNotHold => &mut counts.fails,
                Verdict::NotTestable => &mut counts.untestable,
                Verdict::NoData => &mut counts.missing,
                Verdict::Undecided | Verdict::OneValue { .. } | Verdict::Mixed => &mut counts.undecided,
            } += 1;
            counts.unsure += usize::from(!judgment.stands(p));
            counts.tests += usize::from(p.is_some());
        }
        counts
    }

    /// The number of judgments with runs.
    pub fn judged(&self) -> usize {
        self.holds + self.fails + self.undecided + self.untestable
    }
}

impl fmt::Display for Counts {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let Self { holds, fails, undecided, untestable, missing, .. } = self;
        write!(f, "{holds} hold, {fails} do not hold, {undecided} undecided, {untestable} not testable")?;
        if *missing > 0 { write!(f, ", {missing} without data") } else { Ok(()) }
    }
}
