use barchan_datasets::{open, Rgb};
fn main(){ // temp
  let args: Vec<String>=std::env::args().collect();
  let out=&args[1];
  let mut sheet: Vec<Rgb>=vec![];
  for a in &args[2..]{ let (spec,i)=a.rsplit_once("@").unwrap_or((a,"0")); 
    let t=std::time::Instant::now();
    if a.contains("shared"){ sheet.push(barchan_datasets::read_rgb(a.as_ref()).unwrap()); continue; }
    if spec.ends_with("jpg")||spec.ends_with("png"){ sheet.push(barchan_datasets::read_rgb(spec.as_ref()).unwrap()); continue; }
    let s=open(spec).unwrap(); let t1=t.elapsed(); let f=s.frame(i.parse().unwrap()).unwrap();
    eprintln!("{spec} {:?} {:?}",t1,t.elapsed());
    sheet.push(f.left); }
  let cols=2; let (w,h)=(640u32,480u32);
  let rows=(sheet.len() as u32).div_ceil(cols);
  let mut o=image::RgbImage::new(cols*w,rows*h);
  for (k,im) in sheet.iter().enumerate(){ let (x0,y0)=((k as u32%cols)*w,(k as u32/cols)*h);
    let sc=(im.width() as f32/w as f32).max(im.height() as f32/h as f32);
    for y in 0..h{for x in 0..w{ let (sx,sy)=((x as f32*sc) as u32,(y as f32*sc) as u32); if sx<im.width()&&sy<im.height(){ let p=im[(sx,sy)].0; o.put_pixel(x0+x,y0+y,image::Rgb(p.map(|v|(v*255.0) as u8)));}}}}
  o.save(out).unwrap();
}
