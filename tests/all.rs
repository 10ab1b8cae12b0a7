//! All integration tests, as one program that is linked once. Its tests share a process, and run at the same time: what
//! is changed for a whole process (environment, current folder, signals, limits) is changed in a child.

mod common;

mod benchmarks;
mod claims;
mod cli;
mod cluster;
mod compacted;
mod compare;
mod figures;
mod hostile;
mod integrity;
mod interruption;
mod layers;
mod make;
mod many_runs;
mod models;
mod numbers;
mod publish;
mod reference;
mod removal;
mod report;
mod reproduction;
mod sql;
mod suggestions;
mod tables;
mod worlds;
