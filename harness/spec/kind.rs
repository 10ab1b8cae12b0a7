//! What a YAML file of the harness is, so that a command says it of a file of another kind.

use crate::yaml::{Node, Problem};

/// A kind of YAML file.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum FileKind {
    Experiment,
    Run,
    World,
    Mapping,
    Claims,
}

impl FileKind {
    const ALL: [Self; 5] = [Self::Experiment, Self::Run, Self::World, Self::Mapping, Self::Claims];

    /// The keys that only files of this kind have together.
    fn keys(self) -> &'static [&'static str] {
        match self {
            Self::Experiment => &["scenarios"],
            Self::Run => &["scenario", "seed"],
            Self::World => &["model", "modalities"],
            Self::Mapping => &["source", "modalities"],
            Self::Claims => &["claims"],
        }
    }

    /// What a file is, and how it is used.
    fn described(self) -> (&'static str, &'static str) {
        match self {
            Self::Experiment => ("an experiment", "`harness run SPEC.yaml` does its runs"),
            Self::Run => (
                "the spec of one run",
                "`harness show RUN` prints the command that makes the run, where RUN is the name of this file's folder",
            ),
            Self::World => (
                "a world",
                "give its path in the list 'scenarios' of an experiment's spec, as in \
                 `harness run smoke 'scenarios=[WORLD.yaml]'`",
            ),
            Self::Mapping => {
                ("a mapping of a recording", "`harness import MAPPING.yaml` of the Python package imports it")
            }
            Self::Claims => ("a file of claims", "`harness claims --file CLAIMS.yaml` judges them"),
        }
    }

    /// Refuses a file of another kind.
    pub(crate) fn check(self, tree: &Node) -> Result<(), Problem> {
        let is = |kind: &Self| kind.keys().iter().all(|key| tree.get(key).is_some());
        let Some(other) = Self::ALL.into_iter().find(is).filter(|kind| *kind != self) else { return Ok(()) };
        let ((what, use_), (wanted, _)) = (other.described(), self.described());
        Err(Problem::new(&tree.place, format!("this is {what}, not {wanted}; {use_}")))
    }
}
