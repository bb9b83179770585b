BEGIN TRANSACTION;
CREATE TABLE jobs (
    seq INTEGER PRIMARY KEY,
    id BLOB NOT NULL,
    tenant TEXT NOT NULL,
    kind INTEGER NOT NULL,
    parent BLOB,
    pair_index INTEGER NOT NULL,
    backward INTEGER NOT NULL,
    sees_from INTEGER NOT NULL,
    sees_to INTEGER NOT NULL,
    after BLOB,
    has_dependents INTEGER NOT NULL,
    ready INTEGER,
    pairs INTEGER NOT NULL,
    pairs_left INTEGER NOT NULL,
    priority INTEGER NOT NULL,
    device INTEGER NOT NULL,
    state INTEGER NOT NULL,
    durable INTEGER NOT NULL,
    delayed INTEGER NOT NULL,
    attempt INTEGER NOT NULL,
    failures INTEGER NOT NULL,
    crashes INTEGER NOT NULL,
    delays INTEGER NOT NULL,
    cost REAL NOT NULL,
    closes INTEGER NOT NULL,
    virtual_start REAL NOT NULL,
    virtual_finish REAL NOT NULL,
    options TEXT NOT NULL,
    idempotency_key TEXT,
    fingerprint BLOB,
    created INTEGER NOT NULL,
    started INTEGER,
    finished INTEGER,
    deadline INTEGER,
    expires INTEGER NOT NULL,
    due INTEGER,
    worker TEXT,
    origin INTEGER NOT NULL,
    holder INTEGER,
    progress_done INTEGER,
    progress_total INTEGER,
    loss REAL,
    stop_reason TEXT,
    error_code TEXT,
    error_message TEXT,
    error_retryable INTEGER NOT NULL,
    dead INTEGER NOT NULL,
    cancel_requested INTEGER NOT NULL,
    report TEXT
);
INSERT INTO "jobs" VALUES(1,X'01A212BB784F75C292E9A12BB09CCA64','default',0,NULL,0,0,0,2,NULL,0,1795610605649,0,0,1,0,2,1,0,1,0,0,0,2.60800000000000024857e-02,0,0.0,2.60800000000000024857e-02,'{"preset":"default","seed":0,"ground":"keep","device":"auto","precision":"f32","priority":"normal","labels":{"state":"succeeded"}}','frozen-key',X'31B301B8EA3B41C2434FA7F6EC9EBF8023E118932344153D3B3AD5567689272B',1795610605649,1795610605650,1795610605664,NULL,4795610605649,4795610605664,NULL,0,0,NULL,NULL,NULL,'completed',NULL,NULL,0,0,0,'{"points":240,"valid_points":240,"preset":"default","seed":0,"dt_s":0.1,"dt_assumed":true,"stop_reason":"completed","device":"cpu (AVX-512, 1 threads)","ego_motion":[[0.9999999798835081,0.00019791811810833057,-0.000032579163008320994,0.0982323981988896],[-0.00019791255324663683,0.9999999658417716,0.00017072514927165438,-0.0027584668918294144],[0.00003261295149573212,-0.0001707186980119297,0.9999999848957605,0.00032225163555299675],[0.0,0.0,0.0,1.0]],"ego_covariance":[[9.0,0.0,0.0,0.0,0.0,0.0],[0.0,9.0,0.0,0.0,0.0,0.0],[0.0,0.0,0.00022717289633436338,0.0,0.0,0.0],[0.0,0.0,0.0,0.000027415567780803772,0.0,0.0],[0.0,0.0,0.0,0.0,0.000027415567780803772,0.0],[0.0,0.0,0.0,0.0,0.0,0.030461741978670853]],"overlap":1.0,"warnings":["the sweeps determine the ego motion only along (1.00, 0.00, 0) to 3.0 m and in yaw to 10.0 degrees"],"objects":{"clusters":0,"candidates":0,"searched":0,"moving":0,"cost_m":null,"own_points":0},"seconds":{"precompute":0.012740444,"search":0.0006326519999999992,"total":0.013373096}}');
INSERT INTO "jobs" VALUES(2,X'01A212BB78677756B1D7452CB8D7E9A3','default',0,NULL,0,0,0,2,NULL,0,1795610605673,0,0,1,0,3,1,0,1,1,0,0,2.60800000000000024857e-02,0,0.0,2.60800000000000024857e-02,'{"preset":"default","seed":0,"ground":"keep","device":"auto","precision":"f32","priority":"normal","labels":{"state":"failed"}}',NULL,NULL,1795610605673,1795610605673,1795610605680,NULL,4795610605673,4795610605680,NULL,0,0,NULL,NULL,NULL,NULL,'no_overlap','the sweeps do not show one scene: 0% of what one shows is in the other after the best alignment, 35% are needed: are they consecutive sweeps of one sensor, and is a given ego motion target_from_source? The option force estimates them all the same',0,0,0,NULL);
INSERT INTO "jobs" VALUES(3,X'01A212BB787671A0953CDD149D27A10A','default',1,NULL,0,0,0,2,NULL,0,NULL,2,0,1,0,2,1,0,0,0,0,0,0.0,0,0.0,0.0,'{"preset":"default","seed":0,"ground":"keep","device":"auto","precision":"f32","priority":"normal","labels":{"state":"sequence"}}',NULL,NULL,1795610605688,1795610605689,1795610605715,NULL,4795610605688,4795610605715,NULL,0,NULL,NULL,NULL,NULL,NULL,NULL,NULL,0,0,0,NULL);
INSERT INTO "jobs" VALUES(4,X'01A212BB78787515BDFDEA5BFC500CBD','default',0,X'01A212BB787671A0953CDD149D27A10A',0,0,0,2,NULL,0,1795610605688,0,0,1,0,2,1,0,1,0,0,0,2.60800000000000024857e-02,0,0.0,2.60800000000000024857e-02,'{"preset":"default","seed":0,"ground":"keep","device":"auto","precision":"f32","priority":"normal","labels":{"state":"sequence"}}',NULL,NULL,1795610605688,1795610605689,1795610605703,NULL,4795610605688,NULL,NULL,0,0,NULL,NULL,NULL,'completed',NULL,NULL,0,0,0,'{"points":240,"valid_points":240,"preset":"default","seed":0,"dt_s":0.1,"dt_assumed":true,"stop_reason":"completed","device":"cpu (AVX-512, 1 threads)","ego_motion":[[0.9999999798835081,0.00019791811810833057,-0.000032579163008320994,0.0982323981988896],[-0.00019791255324663683,0.9999999658417716,0.00017072514927165438,-0.0027584668918294144],[0.00003261295149573212,-0.0001707186980119297,0.9999999848957605,0.00032225163555299675],[0.0,0.0,0.0,1.0]],"ego_covariance":[[9.0,0.0,0.0,0.0,0.0,0.0],[0.0,9.0,0.0,0.0,0.0,0.0],[0.0,0.0,0.00022717289633436338,0.0,0.0,0.0],[0.0,0.0,0.0,0.000027415567780803772,0.0,0.0],[0.0,0.0,0.0,0.0,0.000027415567780803772,0.0],[0.0,0.0,0.0,0.0,0.0,0.030461741978670853]],"overlap":1.0,"warnings":["the sweeps determine the ego motion only along (1.00, 0.00, 0) to 3.0 m and in yaw to 10.0 degrees"],"objects":{"clusters":0,"candidates":0,"searched":0,"moving":0,"cost_m":null,"own_points":0},"seconds":{"precompute":0.012294579,"search":0.0003700209999999999,"total":0.0126646}}');
INSERT INTO "jobs" VALUES(5,X'01A212BB787972B8A067617282A5180A','default',0,X'01A212BB787671A0953CDD149D27A10A',1,0,1,3,NULL,0,1795610605689,0,0,1,0,2,1,0,1,0,0,0,2.60800000000000024857e-02,0,2.60800000000000024857e-02,5.21600000000000049715e-02,'{"preset":"default","seed":0,"ground":"keep","device":"auto","precision":"f32","priority":"normal","labels":{"state":"sequence"}}',NULL,NULL,1795610605689,1795610605702,1795610605715,NULL,4795610605689,NULL,NULL,0,0,NULL,NULL,NULL,'completed',NULL,NULL,0,0,0,'{"points":240,"valid_points":240,"preset":"default","seed":0,"dt_s":0.1,"dt_assumed":true,"stop_reason":"completed","device":"cpu (AVX-512, 1 threads)","ego_motion":[[0.9999993875996757,-0.000021123757716520916,-0.0011065053366721169,0.09733423565370723],[0.00002238046808230497,0.9999993547885478,0.0011357471560400853,-0.005310728962869449],[0.0011064806314944507,-0.0011357712246155291,0.9999987428613785,-0.0050814756263870145],[0.0,0.0,0.0,1.0]],"ego_covariance":[[9.0,0.0,0.0,0.0,0.0,0.0],[0.0,9.0,0.0,0.0,0.0,0.0],[0.0,0.0,0.00022714379520006372,0.0,0.0,0.0],[0.0,0.0,0.0,0.000027415567780803772,0.0,0.0],[0.0,0.0,0.0,0.0,0.000027415567780803772,0.0],[0.0,0.0,0.0,0.0,0.0,0.030461741978670853]],"overlap":1.0,"warnings":["the sweeps determine the ego motion only along (1.00, 0.00, 0) to 3.0 m and in yaw to 10.0 degrees"],"objects":{"clusters":0,"candidates":0,"searched":0,"moving":0,"cost_m":null,"own_points":0},"seconds":{"precompute":0.010804618,"search":0.00042457299999999927,"total":0.011229191}}');
INSERT INTO "jobs" VALUES(6,X'01A212BB789B7223B5EE43F635EC4612','default',0,NULL,0,0,0,2,NULL,0,1795610605724,0,0,1,0,1,1,0,1,0,0,0,0.0668038406,0,0.0,0.0668038406,'{"preset":"paper","seed":0,"ground":"keep","device":"auto","precision":"f32","field":{"max_iterations":2000,"patience":2000},"priority":"normal","labels":{"state":"running"}}',NULL,NULL,1795610605724,1795610605725,NULL,NULL,4795610605724,1795610665725,'cpu0',0,0,NULL,NULL,NULL,NULL,NULL,NULL,0,0,0,NULL);
INSERT INTO "jobs" VALUES(7,X'01A212BB7AFF774083D5BC193F643EE7','default',0,NULL,0,0,0,2,NULL,0,1795610606339,0,0,1,0,5,1,0,0,0,0,0,2.60800000000000024857e-02,0,0.0668038406,0.0928838406,'{"preset":"default","seed":0,"ground":"keep","device":"auto","precision":"f32","deadline_ms":1,"priority":"normal","labels":{"state":"expired"}}',NULL,NULL,1795610606339,NULL,1795610606339,1795610606339,1795610606339,4795610606339,NULL,0,NULL,NULL,NULL,NULL,NULL,'deadline_in_queue','the deadline passed before a device was free',1,0,0,NULL);
INSERT INTO "jobs" VALUES(8,X'01A212BB7B0D7690B0CA2B769DC4D9C5','default',0,NULL,0,0,0,2,NULL,0,1795610606350,0,0,1,0,4,1,0,0,0,0,0,2.60800000000000024857e-02,0,0.0668038406,0.0928838406,'{"preset":"default","seed":0,"ground":"keep","device":"auto","precision":"f32","priority":"normal","labels":{"state":"cancelled"}}',NULL,NULL,1795610606350,NULL,1795610606362,NULL,4795610606350,4795610606362,NULL,0,NULL,NULL,NULL,NULL,NULL,NULL,NULL,0,0,1,NULL);
INSERT INTO "jobs" VALUES(9,X'01A212BB7B2473BD8633B34C9C107DE5','default',0,NULL,0,0,0,2,NULL,0,1795610606374,0,0,1,0,0,1,0,0,0,0,0,2.60800000000000024857e-02,0,0.0668038406,0.0928838406,'{"preset":"default","seed":0,"ground":"keep","device":"auto","precision":"f32","priority":"normal","labels":{"state":"queued"}}',NULL,NULL,1795610606374,NULL,NULL,NULL,4795610606374,4795610606374,NULL,0,NULL,NULL,NULL,NULL,NULL,NULL,NULL,0,0,0,NULL);
CREATE TABLE labels (
    owner TEXT NOT NULL,
    label TEXT NOT NULL,
    job BLOB NOT NULL,
    PRIMARY KEY (owner, label, job)
) WITHOUT ROWID;
INSERT INTO "labels" VALUES('default','state=succeeded',X'01A212BB784F75C292E9A12BB09CCA64');
INSERT INTO "labels" VALUES('default','state=failed',X'01A212BB78677756B1D7452CB8D7E9A3');
INSERT INTO "labels" VALUES('default','state=sequence',X'01A212BB787671A0953CDD149D27A10A');
INSERT INTO "labels" VALUES('default','state=running',X'01A212BB789B7223B5EE43F635EC4612');
INSERT INTO "labels" VALUES('default','state=expired',X'01A212BB7AFF774083D5BC193F643EE7');
INSERT INTO "labels" VALUES('default','state=cancelled',X'01A212BB7B0D7690B0CA2B769DC4D9C5');
INSERT INTO "labels" VALUES('default','state=queued',X'01A212BB7B2473BD8633B34C9C107DE5');
CREATE UNIQUE INDEX jobs_id ON jobs (id);
CREATE UNIQUE INDEX jobs_key ON jobs (tenant, idempotency_key) WHERE idempotency_key IS NOT NULL;
CREATE INDEX jobs_ready ON jobs (device, priority DESC, virtual_start, seq)
    WHERE state = 0 AND ready IS NOT NULL AND delayed = 0;
CREATE INDEX jobs_running ON jobs (priority, virtual_start) WHERE state = 1 AND ready IS NOT NULL;
CREATE INDEX jobs_tail ON jobs (tenant, priority, virtual_finish)
    WHERE state < 2 AND (kind = 0 OR ready IS NOT NULL);
CREATE INDEX jobs_due ON jobs (due) WHERE due IS NOT NULL;
CREATE INDEX jobs_after ON jobs (after) WHERE after IS NOT NULL AND state < 2;
CREATE INDEX jobs_ephemeral ON jobs (origin) WHERE durable = 0 AND parent IS NULL AND state < 2;
CREATE INDEX jobs_age ON jobs (ready) WHERE state = 0 AND ready IS NOT NULL;
CREATE INDEX jobs_list ON jobs (tenant, id) WHERE parent IS NULL;
CREATE INDEX jobs_list_by_state ON jobs (tenant, state, id) WHERE parent IS NULL;
CREATE INDEX jobs_parent ON jobs (parent) WHERE parent IS NOT NULL;
CREATE INDEX labels_job ON labels (job);
COMMIT;
PRAGMA user_version = 8;
PRAGMA application_id = 1403415868;
