use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::{Command, Parser};
use clap_complete::Shell;

use crate::output::Output;

/// Let a shell complete commands and options
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan completions bash > ~/.local/share/bash-completion/completions/barchan\n  \
    barchan completions zsh > ~/.zfunc/_barchan")]
pub struct CompletionsArgs {
    /// The shell
    shell: Shell,
}

/// Write a manual page for every command
#[derive(Parser)]
#[command(after_help = "Examples:\n  \
    barchan man --out man1\n  \
    barchan man --out ~/.local/share/man/man1     then: man barchan-slam")]
pub struct ManArgs {
    /// The folder that is written
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// What the shell reads, on standard output.
pub fn completions(args: CompletionsArgs, mut program: Command, output: &Output) -> Result<()> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut program, "barchan", &mut script);
    output.say(&String::from_utf8_lossy(&script));
    Ok(())
}

/// `barchan.1` and one page a command.
pub fn man(args: ManArgs, program: Command, output: &Output) -> Result<()> {
    let out = || args.out.display().to_string();
    std::fs::create_dir_all(&args.out).with_context(out)?;
    clap_mangen::generate_to(program, &args.out).with_context(out)?;
    let pages = Path::new(&args.out).read_dir().with_context(out)?.count();
    output.result(
        &serde_json::json!({ "out": args.out, "files": pages }),
        &format!("{}: {pages} files", out()),
    )
}
