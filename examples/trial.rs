//! scratch
use fnsf::flow::{*, backend::*, cpu::*, distance::*};
use std::time::Instant;
struct W(Instant);
impl Watch for W { fn seconds(&self) -> f64 { self.0.elapsed().as_secs_f64() } }
struct P { s: Vec<Point>, t: Vec<Point>, f: Vec<Point>, v: Vec<u8>, d: Vec<u8> }
fn load(n: &str) -> P {
    let b = std::fs::read(format!("/tmp/exp/{n}.bin")).unwrap();
    let u = |i: usize| u32::from_le_bytes(b[i*4..i*4+4].try_into().unwrap()) as usize;
    let (n1,n2)=(u(0),u(1));
    let mut at=8;
    let mut pts=|n: usize| -> Vec<Point> { let r=(0..n).map(|i| std::array::from_fn(|a| f32::from_le_bytes(b[at+i*12+a*4..at+i*12+a*4+4].try_into().unwrap()))).collect(); at+=n*12; r };
    let s=pts(n1); let t=pts(n2); let f=pts(n1);
    let v=b[at..at+n1].to_vec(); let d=b[at+n1..at+2*n1].to_vec();
    P{s,t,f,v,d}
}
fn rigid(src:&[Point], d:&DistanceTransform, every:usize, iters:usize, s0:f64, s1:f64)->nalgebra::Isometry3<f64>{
    use nalgebra::*;
    let mut t=Isometry3::<f64>::identity();
    for it in 0..iters {
        let f=it as f64/(iters-1).max(1) as f64; let sc=s0*(s1/s0).powf((f*1.5).min(1.0));
        let mut h=Matrix6::<f64>::zeros(); let mut g=Vector6::<f64>::zeros();
        for p in src.iter().step_by(every) {
            let q=t*Point3::new(p[0] as f64,p[1] as f64,p[2] as f64);
            let s=d.sample([q.x as f32,q.y as f32,q.z as f32]);
            let r=s.distance as f64; let n=Vector3::new(s.gradient[0] as f64,s.gradient[1] as f64,s.gradient[2] as f64);
            let w={let k=sc*sc/(sc*sc+r*r); k*k};
            let c=q.coords.cross(&n);
            let j=Vector6::new(n.x,n.y,n.z,c.x,c.y,c.z);
            h+=j*j.transpose()*w; g+=j*(w*r);
        }
        for i in 0..6 {h[(i,i)]+=1e-6;}
        if let Some(x)=h.cholesky().map(|c|c.solve(&(-g))) {
            let dt=Isometry3::new(Vector3::new(x[0],x[1],x[2]),Vector3::new(x[3],x[4],x[5]));
            t=dt*t;
            if x.norm()<1e-5 && f>0.67 {break;}
        }
    }
    t
}
fn main() {
    let args: Vec<String> = std::env::args().collect();
    let get=|k:&str, d:&str| args.iter().find_map(|a| a.strip_prefix(&format!("{k}="))).unwrap_or(d).to_string();
    let num=|k:&str,d:f64| get(k,&d.to_string()).parse::<f64>().unwrap();
    let mut o = Options { seed:0, distance: DistanceOptions::default(), inputs: Inputs::Raw, start: Start::Xavier, learning_rate: num("lr",0.008) as f32, batch: None, decay: Decay::Constant, beta2: num("b2",0.999) as f32, average: None, truncation_m: None, dead: num("dead",0.0) as f32, norm: num("norm",0.0) as f32, early_stop: None, max_iterations: num("it",5000.0) as usize };
    if num("scale",0.0)>0.0 { o.inputs=Inputs::Centered{scale_m:num("scale",0.0) as f32}; }
    if num("pts",0.0)>0.0 { o.distance.sites=Sites::Points; } if num("zero",0.0)>0.0 { o.start=Start::ZeroFlow; }
    if num("batch",0.0)>0.0 { o.batch=Some(num("batch",0.0) as usize); }
    if num("ema",0.0)>0.0 { o.average=Some(num("ema",0.0) as f32); }
    if num("trunc",0.0)>0.0 { o.truncation_m=Some(num("trunc",0.0) as f32); }
    if num("pat",10.0)>0.0 { o.early_stop=Some(EarlyStopOptions{patience:num("pat",10.0) as usize,min_delta_m:num("delta",1e-3)}); }
    match get("decay","c").as_str() { "l"=>o.decay=Decay::Linear, "cos"=>o.decay=Decay::Cosine, _=>{} }
    let backend = CpuBackend::new(None).unwrap();
    let seeds=num("seeds",3.0) as u64; let max=num("max",0.0) as usize;
    for name in get("pair","av2_7fab,kitti_0000,small_gicp").split(',') {
        let p=load(name);
        let mut rows=vec![];
        for seed in 0..seeds {
            o.seed=seed;
            let (mut src,mut tgt,mut idx)=(p.s.clone(),p.t.clone(),(0..p.s.len()).collect::<Vec<_>>());
            if max>0 { let n=src.len().min(tgt.len()); let mut pm:Vec<usize>=(0..n).collect(); let mut r=seed*7919+13; for i in (1..n).rev(){ r=r.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407); pm.swap(i,((r>>33) as usize)%(i+1)); } pm.truncate(max); src=pm.iter().map(|&i|p.s[i]).collect(); tgt=pm.iter().map(|&i|p.t[i]).collect(); idx=pm; }
            let w=W(Instant::now());
            let orig=src.clone();
            if num("rigid",0.0)>0.0 { let d=DistanceTransform::build(&src,&tgt,&o.distance).unwrap(); let a=w.seconds(); let tr=rigid(&src,&d,(src.len()/num("rn",8000.0) as usize).max(1),num("rigid",0.0) as usize,num("s0",1.0),num("s1",0.1)); if num("v",0.0)>1.0 {println!("   rigid {:.4} s t {:?} angle {:.3} deg",w.seconds()-a,tr.translation.vector.as_slice(),tr.rotation.angle().to_degrees());} for p in &mut src { let q=tr*nalgebra::Point3::new(p[0] as f64,p[1] as f64,p[2] as f64); *p=[q.x as f32,q.y as f32,q.z as f32]; } }
            let mut t=backend.start(&src,&tgt,&o).unwrap();
            let pre=w.seconds();
            loop { match t.advance(100,&w).unwrap() { Advance::Continues=>{}, _=>break } }
            let flow=t.evaluate(&src).unwrap();
            let flow:Vec<Point>=flow.iter().zip(&src).zip(&orig).map(|((f,s),o)|std::array::from_fn(|a|f[a]+s[a]-o[a])).collect(); let total=w.seconds();
            let r=t.report();
            let (mut e,mut a5,mut n,mut ed,mut nd)=(0.0,0.0,0.0,0.0,0.0);
            for (k,&i) in idx.iter().enumerate() { if p.v[i]==0 {continue;} let er=(0..3).map(|a|((flow[k][a]-p.f[i][a]) as f64).powi(2)).sum::<f64>().sqrt(); let m=(0..3).map(|a|(p.f[i][a] as f64).powi(2)).sum::<f64>().sqrt(); e+=er; n+=1.0; if er<0.05||er/(m+1e-20)<0.05 {a5+=1.0;} if p.d[i]!=0 {ed+=er;nd+=1.0;} }
            if num("v",0.0)>0.0 { println!("  {name} s{seed} epe {:.4} a5 {:.3} dyn {:.3} it {} best {} loss {:.4} pre {:.3} q {:.3} net {:.3} tot {:.3} MB {:.0}",e/n,a5/n,ed/nd,r.iterations,r.best_iteration,r.best_loss,pre,r.query_seconds,r.network_seconds,total,r.distance_bytes as f64/1e6); }
            rows.push((e/n,a5/n,ed/nd,r.iterations as f64,total));
        }
        let med=|f:&dyn Fn(&(f64,f64,f64,f64,f64))->f64|{let mut v:Vec<f64>=rows.iter().map(f).collect(); v.sort_by(f64::total_cmp); (v[v.len()/2],v[v.len()-1],v[0])};
        let (e,emax,_)=med(&|r|r.0); let (a,_,amin)=med(&|r|r.1); let (d,_,_)=med(&|r|r.2); let (it,_,_)=med(&|r|r.3);let (tt,_,_)=med(&|r|r.4);
        println!("{name:16} epe {e:.4} (max {emax:.4} x{:.2}) a5 {a:.3} (min {amin:.3}) dyn {d:.3} it {it} time {tt:.2}", emax/e);
    }
}
