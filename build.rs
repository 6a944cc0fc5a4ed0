//! Where a build with libtorch finds it when it runs, so that nobody has to set a search path.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rerun-if-env-changed=LIBTORCH");
    let with_libtorch = std::env::var_os("CARGO_FEATURE_TCH").is_some();
    if let (true, Ok(libtorch)) = (with_libtorch, std::env::var("LIBTORCH")) {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{libtorch}/lib");
    }
}
