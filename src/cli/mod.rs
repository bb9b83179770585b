//! The command line: one file per subcommand. The only module that prints.
//!
//! Results go to stdout, progress and errors to stderr. No other module depends on this one.

mod backup;
mod client;
mod densify;
mod device;
mod estimation;
mod failure;
mod files;
mod machine;
mod output;
mod terminal;
mod tracks;
mod unfinished;

mod demo;
mod doctor;
mod eval;
mod export;
mod flow;
mod jobs;
mod label;
mod laz;
mod migrate;
mod serve;
mod submit;
mod synth;
mod tables;
mod unpack;
mod view;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Scene flow from lidar: estimates the displacement of every point between two sweeps.
#[derive(Debug, Parser)]
#[command(name = "fnsf", version, propagate_version = true, max_term_width = 100)]
#[command(after_help = "Start here:\n  \
    fnsf demo                                  a simulated street, its flow, its error, a picture\n  \
    fnsf serve                                 HTTP and gRPC on 127.0.0.1:8080\n  \
    fnsf flow a.pcd b.pcd -o flow.npz          two sweeps, any format\n  \
    fnsf flow a.pcd b.pcd --picture flow.png   the same, to look at\n  \
    fnsf view a.pcd b.pcd                      the same in 3-D, in a browser
  \
    fnsf densify *.pcd --reference-time 5 -o dense.laz   a drive's sweeps as one dense cloud\n  \
    fnsf label drives/ -o labels               the flows of many drives, in shards")]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    Demo(demo::Demo),
    Serve(Box<serve::Serve>),
    Submit(Box<submit::Submit>),
    Jobs(jobs::Jobs),
    Backup(backup::Backup),
    Restore(backup::Restore),
    Migrate(migrate::Migrate),
    Flow(flow::Flow),
    Densify(densify::Densify),
    Eval(eval::Eval),
    Label(Box<label::Label>),
    View(Box<view::View>),
    Synth(synth::Synth),
    Unpack(unpack::Unpack),
    Export(export::Export),
    Tables(tables::Tables),
    Doctor(doctor::Doctor),
}

/// Runs the command and returns its exit code: 0 success, 2 usage error, 65 bad input, 70 internal
/// error, 75 try again. Prints a failure as one line on stderr. A closed stdout is a success.
pub fn run(arguments: Arguments) -> ExitCode {
    let done = match arguments.command {
        Command::Demo(command) => command.run(),
        Command::Serve(command) => command.run(),
        Command::Submit(command) => command.run(),
        Command::Jobs(command) => command.run(),
        Command::Backup(command) => command.run(),
        Command::Restore(command) => command.run(),
        Command::Migrate(command) => command.run(),
        Command::Flow(command) => command.run(),
        Command::Densify(command) => command.run(),
        Command::Eval(command) => command.run(),
        Command::Label(command) => command.run(),
        Command::View(command) => command.run(),
        Command::Synth(command) => command.run(),
        Command::Unpack(command) => command.run(),
        Command::Export(command) => command.run(),
        Command::Tables(command) => command.run(),
        Command::Doctor(command) => command.run(),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            if !failure.is_of_reader() {
                output::complain(format_args!("{failure}"));
            }
            failure.exit_code()
        }
    }
}
