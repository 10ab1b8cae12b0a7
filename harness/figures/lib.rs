//! The paper's figures, and one about it, drawn from the tables of finished runs.
//!
//! One file a figure; each makes a [`Drawing`]: a [`page::Page`] and the numbers on it. The scenes are rendered by
//! `simulation`, the diagrams are read off the networks that `learning` builds, everything else comes from
//! [`source::Source`], by the runs that [`analysis`](harness_analysis) lets count. The same tables give the same bytes of SVG.

mod axes;
mod curves;
mod diagram;
mod forces_dataset;
mod information_loss_arch;
pub mod page;
mod prediction_results;
mod predictive_arch;
mod propriovision_to_vision;
mod readings;
mod reconstruction_performance;
mod regression;
mod sim_env;
pub mod source;
mod task;
mod text;

pub use forces_dataset::SQL as FORCES_SQL;
use harness_analysis::Mixed;
use harness_learning::LearningError;
use harness_registry::{QueryError, save};
use harness_shared::files::{WriteError, write_bytes};
use harness_simulation::SimulationError;
use page::Page;
use polars::prelude::{DataFrame, PolarsError};
use source::Source;
use std::path::{Path, PathBuf};

/// Why a figure can't be drawn.
#[derive(Debug, thiserror::Error)]
pub enum FigureError {
    #[error("{} has no finished run of {experiment}; make them with `{command}`", root.display())]
    NoRuns { experiment: String, root: PathBuf, command: String },
    #[error(
        "the finished runs of {experiment} in {} lack what the figure shows: a scenario, or a table that earlier \
         versions didn't write; make them with `{command}`, in a new results folder if they are of such a version",
        root.display()
    )]
    NoRows { experiment: String, root: PathBuf, command: String },
    #[error(transparent)]
    Mixed(#[from] Mixed),
    #[error(transparent)]
    Query(#[from] QueryError),
    #[error("a table doesn't hold what it should: {0}")]
    Table(#[from] PolarsError),
    #[error(transparent)]
    Simulation(#[from] SimulationError),
    #[error(transparent)]
    Learning(#[from] LearningError),
    #[error("the picture can't be made: {0}")]
    Picture(String),
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl FigureError {
    /// Whether the figure waits for runs that aren't there.
    pub fn is_missing_runs(&self) -> bool {
        matches!(self, Self::NoRuns { .. } | Self::NoRows { .. })
    }
}

/// A figure of the paper, or about it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Figure {
    Task,
    SimEnv,
    PredictiveArch,
    InformationLossArch,
    ForcesDataset,
    PredictionResults,
    PropriovisionToVision,
    ReconstructionPerformance,
    Regression,
    /// What no figure of the paper shows: what depends on how it is read.
    Readings,
}

/// A file that a figure is saved as.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    Svg,
    Png,
    /// The numbers.
    Csv,
}

impl Format {
    pub const ALL: [Format; 3] = [Format::Svg, Format::Png, Format::Csv];

    /// The ending of the file's name.
    pub fn name(self) -> &'static str {
        match self {
            Format::Svg => "svg",
            Format::Png => "png",
            Format::Csv => "csv",
        }
    }
}

/// A figure and the numbers that it shows.
pub struct Drawing {
    pub page: Page,
    pub data: DataFrame,
}

impl Figure {
    /// Those of the paper in its order, and the one about it.
    pub const ALL: [Figure; 10] = [
        Figure::Task,
        Figure::PredictiveArch,
        Figure::InformationLossArch,
        Figure::SimEnv,
        Figure::ForcesDataset,
        Figure::PredictionResults,
        Figure::PropriovisionToVision,
        Figure::ReconstructionPerformance,
        Figure::Regression,
        Figure::Readings,
    ];

    /// The paper's figures, in its order: all but the last.
    pub const OF_THE_PAPER: [Figure; 9] = *Self::ALL.first_chunk().unwrap();

    /// The name in files and on the command line: the paper's label.
    pub fn name(self) -> &'static str {
        match self {
            Figure::Task => "task",
            Figure::SimEnv => "sim_env",
            Figure::PredictiveArch => "predictive_arch",
            Figure::InformationLossArch => "information_loss_arch",
            Figure::ForcesDataset => "forces_dataset",
            Figure::PredictionResults => "prediction_results",
            Figure::PropriovisionToVision => "propriovision_to_vision",
            Figure::ReconstructionPerformance => "reconstruction_performance",
            Figure::Regression => "regression",
            Figure::Readings => "readings",
        }
    }

    /// What it shows.
    pub fn meaning(self) -> &'static str {
        match self {
            Figure::Task => "the finger pressed on the ground among movable boxes",
            Figure::SimEnv => "the robot, its joints, and the finger close up",
            Figure::PredictiveArch => "the network that predicts the next observation",
            Figure::InformationLossArch => "the network that reconstructs the observation",
            Figure::ForcesDataset => "contact and force by link, both scenarios",
            Figure::PredictionResults => "prediction errors over latent size, single- and multi-modal",
            Figure::PropriovisionToVision => "predicted change of the image beside the reference",
            Figure::ReconstructionPerformance => {
                "reconstruction errors over latent size, single- and multi-modal"
            }
            Figure::Regression => "prediction over reference at the fingertip",
            Figure::Readings => "what vision adds under each reading of the paper",
        }
    }

    /// Whether it depends on runs; the others show the simulated world alone.
    pub fn shows_runs(self) -> bool {
        !matches!(self, Figure::Task | Figure::SimEnv)
    }

    /// Draws it.
    ///
    /// # Errors
    /// When its runs are missing ([`FigureError::is_missing_runs`]), or tables or pictures can't be made.
    pub fn draw(self, source: &Source) -> Result<Drawing, FigureError> {
        match self {
            Figure::Task => task::draw(),
            Figure::SimEnv => sim_env::draw(),
            Figure::PredictiveArch => predictive_arch::draw(source),
            Figure::InformationLossArch => information_loss_arch::draw(source),
            Figure::ForcesDataset => forces_dataset::draw(source),
            Figure::PredictionResults => prediction_results::draw(source),
            Figure::PropriovisionToVision => propriovision_to_vision::draw(source),
            Figure::ReconstructionPerformance => reconstruction_performance::draw(source),
            Figure::Regression => regression::draw(source),
            Figure::Readings => readings::draw(source),
        }
    }
}

impl Drawing {
    /// Writes `<folder>/<name>.<format>` of each format.
    pub fn save(mut self, folder: &Path, name: &str, formats: &[Format]) -> Result<(), FigureError> {
        let svg = self.page.svg();
        for format in formats {
            let path = folder.join(format!("{name}.{}", format.name()));
            match format {
                Format::Svg => write_bytes(&path, svg.as_bytes())?,
                Format::Png => write_bytes(&path, &Page::png(&svg)?)?,
                Format::Csv => save(&mut self.data, &path)?,
            }
        }
        Ok(())
    }
}
