import os, sys, time, traceback
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"
import numpy as np
import jaxbundle
jaxbundle.enable_x64()
from random_problems import *
import jax

def check(seed, derivatives=False):
    p = make_random(seed//4, seed%4)
    right = Dense(p).solve()
    start = [dataclasses.replace(t, value=np.where(t.free.reshape(np.shape(t.value)) > 0, t.value + 0.05*np.random.default_rng(seed).normal(size=np.shape(t.value)), t.value)) for t in p.tables]
    p = dataclasses.replace(p, tables=start)
    R = p.adjust()
    if not R.converged: return f"not converged: {R.termination} {R.undetermined[:3]}"
    bad = []
    def near(name, a, b, tol, scale=1.0):
        a, b = np.asarray(a), np.asarray(b)
        e = np.abs(a-b)/scale
        if a.shape != b.shape or not (e <= tol).all(): bad.append(f"{name} {a.shape}{b.shape} {np.nanmax(e) if a.shape==b.shape else ''}")
    c = R.counts
    near("counts", [c.observations, c.unknowns, c.datum, c.redundancy], [right.observations, right.unknowns, right.defect, right.redundancy], 0)
    here = Dense(p, R.minimum.values)
    Q = here.cofactors
    sig = np.sqrt(np.diag(Q))
    dx = right.estimable(right.vector()) - right.estimable(right.vector(R.minimum.values))
    near("values", dx, 0*dx, 1e-4, sig)
    near("vtpv", R.vtpv, here.r@here.r, 1e-9, here.r@here.r)
    inner = p.options.get("datum", "inner") == "inner"
    s0 = R.sigma0
    names=[t.name for t in p.tables]
    def func(values):
        import jax.numpy as jnp
        return jnp.concatenate([jnp.ravel(values[n]) for n in names])[here.free]
    C = R.covariance(func)/s0**2
    if inner:
        near("covariance", C, Q, 1e-7, np.outer(sig,sig))
        for t in p.tables:
            pass
        S = np.concatenate([np.ravel(R[n].sigma) for n in names])[here.free]/s0
        near("sigma", S, sig, 1e-7, sig)
    else:
        P = np.eye(len(Q)) 
        if here.defect:
            q=np.linalg.qr(here.gauge)[0]; P = P-q@q.T
        near("covariance", P@C@P, Q, 1e-7, np.outer(sig,sig))
    for o,(v,J,root,obs) in enumerate(zip(here.v, here.by_set, here.root, p.observations)):
        h = np.einsum("niu,uv,niv->ni", J, Q, J)
        used = here.used[o] > 0
        near(f"residual {o}", R.solution.residuals[o], v, 1e-8)
        near(f"redundancy {o}", R.solution.reliability.redundancy[o], np.where(used, np.clip(1-h,0,1), 0), 1e-7)
    if derivatives:
        bad += check_derivatives(p, R, seed)
    return "; ".join(bad)

def check_derivatives(p, R, seed): return []

if __name__ == "__main__":
    a,b = map(int, sys.argv[1:3])
    n=0
    for seed in range(a,b):
        t=time.time()
        try: out = check(seed)
        except Exception as e:
            out = "EXC " + repr(e)[:200] + " @ " + "; ".join(f"{f.filename.split('/')[-1]}:{f.lineno}" for f in traceback.extract_tb(e.__traceback__) if "leastsquares" in f.filename)[-120:]
        n += bool(out)
        if out: print(seed, f"{time.time()-t:.1f}", out, flush=True)
    print("wrong", n, "of", b-a)
