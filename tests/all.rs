//! All integration tests, as one program that is linked once. The tests share a process and run at the same time. So a
//! test that changes the environment, the current folder, signals or limits must do so in a child process.

mod common;

mod benchmarks;
mod claims;
mod cli;
mod cluster;
mod compacted;
mod compare;
mod cycles;
mod external;
mod figures;
mod first_worlds;
mod foreign;
mod formats;
mod horizons;
mod hostile;
mod integrity;
mod interruption;
mod layers;
mod live;
mod locks;
mod many_runs;
mod missing;
mod models;
mod numbers;
mod outside;
mod own_test;
mod paths;
mod plot;
mod publish;
mod random_models;
mod readme;
mod reference;
mod removal;
mod report;
mod search;
mod serve;
mod sql;
mod suggestions;
mod tables;
mod terminal;
mod versions;
mod worlds;
