//! The command line of Barchan: from unlabelled rover stereo to metric terrain.
//!
//! One module per subcommand under [`commands`], each an `Args` struct and a `run`. No algorithm
//! lives here: a command opens its inputs, calls the crates, and writes what they return.

mod commands;
mod data;
mod engine;
mod output;
mod preview;
mod slam_run;

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};

/// From unlabelled rover stereo to metric terrain.
#[derive(Parser)]
#[command(
    name = "barchan",
    version,
    propagate_version = true,
    after_help = "A first run, with nothing but this program:\n  \
        barchan demo --out demo\n\
        and then with your images:\n  \
        barchan demo --data folder:my_images --out day1"
)]
struct Cli {
    /// Print machine-readable JSON on standard output instead of tables.
    #[arg(long, global = true)]
    json: bool,
    /// Where libonnxruntime.so is; by default $BARCHAN_ONNXRUNTIME, then what `make onnxruntime` installed.
    #[arg(long, global = true, value_name = "PATH")]
    onnxruntime: Option<std::path::PathBuf>,
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    Demo(commands::demo::Args),
    Train(Box<commands::train::Args>),
    Adapt(commands::adapt::Args),
    Export(commands::export::Args),
    Probe(commands::probe::Args),
    Features(commands::features::Args),
    Infer(commands::infer::Args),
    Slam(commands::slam::Args),
    Map(commands::map::Args),
    Noise(commands::noise::Args),
    Raster(commands::raster::Args),
    Report(commands::report::Args),
    View(commands::view::Args),
    Serve(commands::serve::Args),
    Eval(commands::eval::Args),
    Compare(commands::compare::Args),
    Data(commands::data::Args),
    Vocabulary(commands::vocabulary::Args),
    Doctor(commands::doctor::Args),
    Completions(commands::completions::CompletionsArgs),
    Man(commands::completions::ManArgs),
}

fn main() -> ExitCode {
    let cli = Cli::parse();
    let output = output::Output {
        json: cli.json,
        quiet: false,
    };
    let runtime = cli.onnxruntime.as_deref();
    let result = match cli.command {
        Command::Demo(args) => commands::demo::run(args, &output, runtime),
        Command::Train(args) => match commands::train::run(*args, &output) {
            Ok(false) => return ExitCode::from(commands::train::INTERRUPTED),
            other => other.map(|_| ()),
        },
        Command::Adapt(args) => commands::adapt::run(args, &output),
        Command::Export(args) => commands::export::run(args, &output, runtime),
        Command::Probe(args) => commands::probe::run(args, &output, runtime),
        Command::Features(args) => commands::features::run(args, &output),
        Command::Infer(args) => commands::infer::run(args, &output, runtime),
        Command::Slam(args) => commands::slam::run(args, &output, runtime),
        Command::Map(args) => commands::map::run(args, &output),
        Command::Noise(args) => commands::noise::run(args, &output, runtime),
        Command::Raster(args) => commands::raster::run(args, &output),
        Command::Report(args) => commands::report::run(args, &output),
        Command::View(args) => commands::view::run(args, &output),
        Command::Serve(args) => commands::serve::run(args, &output, runtime),
        Command::Eval(args) => commands::eval::run(args, &output, runtime),
        Command::Compare(args) => commands::compare::run(args, &output, runtime),
        Command::Data(args) => match commands::data::run(args, &output) {
            // A check that found something is no error, and scripts want to know.
            Ok(false) => return ExitCode::from(1),
            other => other.map(|_| ()),
        },
        Command::Vocabulary(args) => commands::vocabulary::run(args, &output),
        Command::Doctor(args) => commands::doctor::run(args, &output, runtime),
        Command::Completions(args) => {
            commands::completions::completions(args, Cli::command(), &output)
        }
        Command::Man(args) => commands::completions::man(args, Cli::command(), &output),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Nobody is left to tell when standard error is gone too.
            eprintln!("error: {error:#}");
            ExitCode::from(2)
        }
    }
}
